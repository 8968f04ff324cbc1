"""Processor time of a controller step, beside a predict + update of filterpy's KalmanFilter."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import sin

import numpy as np
from numpy.typing import NDArray
from reporting import Check

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.assembly import law_fits

Array = NDArray[np.float64]

DEFAULT = 'moving_horizon'
LAWS = (DEFAULT, 'lms', 'printed', 'fixed')
STRUCTURES = ('proportional', 'tracking')
SKIPPED, TIMED = 600, 2000  # samples
# In units of one predict + update.
MEDIAN_LIMITS = {
    f'{DEFAULT}, proportional': 0.5, f'{DEFAULT}, tracking': 1.5, 'lms, proportional': 0.5,
}
P99_LIMIT = 4.0  # of the default law
REFERENCE_STATES = 6
STEP_HEADER = ('step', 'median / filter', 'p99 / filter', 'median [us]', 'p99 [us]')


class Sampled:
    """One sample after the other, with the time of the controller's part of each.

    A sine is applied instead of the command, and the controller is told so: every law in every
    structure works on the same data, whether its own loop is stable or not. What the command need
    not wait for is done in `refine`, which is timed on its own.
    """

    def __init__(self, parameters: Parameters, skip: int = 0) -> None:
        self._loop = build_closed_loop(parameters)
        self._amplitude = parameters.amplitude
        self._frequency = parameters.frequency
        self._period = parameters.sample_period
        self._applied: tuple[float, ...] = ()
        self._sample = 0
        self.refined = 0.0  # time of the newest call of refine [s]
        for _ in range(skip):
            self.step()

    def step(self) -> float:
        """Run one sample and return the time of the controller's step [s]."""
        controller, plant = self._loop.controller, self._loop.plant
        t = self._sample * self._period
        y, y_m = plant.measure(), self._loop.reference(t)
        begun = time.thread_time()
        controller.step(y, y_m, applied=self._applied)
        stepped = time.thread_time()
        controller.refine()
        self.refined = time.thread_time() - stepped
        self._applied = (self._amplitude * sin(self._frequency * t),)
        plant.step(*self._applied)
        self._sample += 1
        return stepped - begun


def filter_timer() -> Callable[[], float]:
    """A function that runs and times one predict + update of a six-state filter."""
    from filterpy.kalman import KalmanFilter  # type: ignore[import-untyped]
    reference = KalmanFilter(dim_x=REFERENCE_STATES, dim_z=1)
    reference.P *= 10.0
    reference.R *= 0.1
    reference.H[0, 0] = 1.0

    def step() -> float:
        start = time.thread_time()
        reference.predict()
        reference.update(0.1)
        return time.thread_time() - start

    return step


def law_times() -> dict[str, Array]:
    """Times of every law in every structure and of the filter [s], shape (TIMED,) each."""
    contestants: dict[str, Callable[[], float]] = {
        f'{law}, {structure}': Sampled(Parameters({
            'estimator.law': law, 'structure': structure, 'output_noise_std': 1e-3,
        }), SKIPPED).step
        for structure in STRUCTURES for law in LAWS if law_fits(law, structure)
    }
    contestants['filterpy, 6 states'] = filter_timer()
    names = list(contestants)
    times = {name: np.empty(TIMED) for name in names}
    for i in range(TIMED):
        # They take turns, so that a slow moment of the machine hits all; and nobody always follows
        # the same neighbour, whose data would be in its cache.
        for name in names[i % len(names):] + names[:i % len(names)]:
            times[name][i] = contestants[name]()
    return times


def step_rows(times: dict[str, Array]) -> list[list[str]]:
    """Cells of the table."""
    unit = float(np.median(times['filterpy, 6 states']))
    rows = []
    for name, of in times.items():
        median, p99 = float(np.median(of)), float(np.quantile(of, 0.99))
        rows.append([name, f'{median / unit:.2f}', f'{p99 / unit:.2f}', f'{1e6 * median:.0f}',
                     f'{1e6 * p99:.0f}'])
    return rows


def step_checks(times: dict[str, Array]) -> list[Check]:
    """The bounds on a step in units of the filter."""
    unit = float(np.median(times['filterpy, 6 states']))
    checks = []
    for name, limit in MEDIAN_LIMITS.items():
        of = times[name]
        limits = [('median', float(np.median(of)) / unit, limit)]
        if name.startswith(DEFAULT):
            limits.append(('p99', float(np.quantile(of, 0.99)) / unit, P99_LIMIT))
        checks += [
            Check(f'{what} controller step with {name} / predict + update of a six-state filter',
                  f'<= {most:g}', f'{ratio:.2f}', ratio <= most)
            for what, ratio, most in limits
        ]
    return checks
