"""Processor time of a controller step, beside a predict + update of filterpy's KalmanFilter."""

import time
from collections.abc import Callable
from itertools import product
from math import sin

import numpy as np
from reporting import Array, Check, Measured

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.assembly import law_fits

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
        self._loop, self._p = build_closed_loop(parameters), parameters
        self._applied: tuple[float, ...] = ()
        self._sample = 0
        self.refined = 0.0  # time of the newest call of refine [s]
        for _ in range(skip):
            self.step()

    def step(self) -> float:
        """Run one sample and return the time of the controller's step [s]."""
        controller, plant = self._loop.controller, self._loop.plant
        t = self._sample * self._p.sample_period
        y, y_m = plant.measure(), self._loop.reference(t)
        begun = time.thread_time()
        controller.step(y, y_m, applied=self._applied)
        stepped = time.thread_time()
        controller.refine()
        self.refined = time.thread_time() - stepped
        self._applied = (self._p.amplitude * sin(self._p.frequency * t),)
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
    contestants: dict[str, Callable[[], float]] = {}
    for structure, law in product(STRUCTURES, LAWS):
        if law_fits(law, structure):
            contestants[f'{law}, {structure}'] = Sampled(Parameters({
                'estimator.law': law, 'structure': structure, 'output_noise_std': 1e-3,
            }), SKIPPED).step
    contestants['filterpy, 6 states'] = filter_timer()
    names = list(contestants)
    times = {name: np.empty(TIMED) for name in names}
    for i in range(TIMED):
        # They take turns, so that a slow moment of the machine hits all; and nobody always follows
        # the same neighbour, whose data would be in its cache.
        for name in names[i % len(names):] + names[:i % len(names)]:
            times[name][i] = contestants[name]()
    return times


def measure_steps(_: float) -> Measured:
    """Cells of the table, and the bounds on a step in units of the filter."""
    times, rows, checks = law_times(), [], []
    unit = float(np.median(times['filterpy, 6 states']))
    for name, of in times.items():
        median, p99 = float(np.median(of)), float(np.quantile(of, 0.99))
        rows.append([name, f'{median / unit:.2f}', f'{p99 / unit:.2f}', f'{1e6 * median:.0f}',
                     f'{1e6 * p99:.0f}'])
        limits = [('median', median / unit, MEDIAN_LIMITS.get(name, np.inf)),
                  ('p99', p99 / unit, P99_LIMIT if name.startswith(DEFAULT) else np.inf)]
        checks += [
            Check(f'{what} controller step with {name} / predict + update of a six-state filter',
                  f'<= {most:g}', f'{ratio:.2f}', ratio <= most)
            for what, ratio, most in limits if most < np.inf
        ]
    return rows, checks
