"""Time of one whole controller step, beside one predict + update of filterpy's KalmanFilter."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, sin

import numpy as np
from numpy.typing import NDArray
from reporting import Check

from backlash_ros.core.assembly import law_fits
from backlash_ros.core.control.controller import REFINE_SHARE
from backlash_ros.core.estimate import Status
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop

try:
    from filterpy.kalman import KalmanFilter  # type: ignore[import-untyped]
except ImportError:
    KalmanFilter = None
HAS_FILTER = KalmanFilter is not None

Array = NDArray[np.float64]

DEFAULT = 'moving_horizon'
LAWS = (DEFAULT, 'lms', 'printed', 'fixed')
STRUCTURES = ('proportional', 'tracking')
ORDERS = (2, 4, 8)
UNCERTAINTIES = {0.0: 'exact', 0.2: 'uncertain'}  # plant.uncertainty: K = 0, or all error terms
ACQUISITION, STEADY_FROM, TIMED = 100, 600, 2000  # samples
ACQUISITIONS = 10  # runs, each with its own seed
# In units of one predict + update.
MEDIAN_LIMITS = {
    (DEFAULT, 'proportional'): 0.5, (DEFAULT, 'tracking'): 1.5, ('lms', 'proportional'): 0.5,
}
P99_LIMIT = 4.0  # of the default law
REFERENCE_STATES = 6
NOISE = 1e-3
MISSING = 'filterpy is not installed: steps are not compared with it (pip install filterpy)'


@dataclass(frozen=True)
class Timing:
    """Times of one contestant [s], and the median of the filter timed in the same loop."""

    what: str
    phase: str
    times: Array
    yardstick: float | None

    @property
    def median(self) -> float:
        """Median time [s]."""
        return float(np.median(self.times))

    @property
    def ratio(self) -> float | None:
        """Median in units of the yardstick."""
        return None if self.yardstick is None else self.median / self.yardstick

    @property
    def p99_ratio(self) -> float | None:
        """99th percentile in units of the yardstick."""
        return None if self.yardstick is None else \
            float(np.quantile(self.times, 0.99)) / self.yardstick

    @property
    def row(self) -> list[str]:
        """Cells: what, phase, ratio of the median, ratio of p99, microseconds of both."""
        p99 = float(np.quantile(self.times, 0.99))
        ratios = ['-', '-'] if self.yardstick is None else [
            f'{self.median / self.yardstick:.2f}', f'{p99 / self.yardstick:.2f}']
        return [self.what, self.phase, *ratios, f'{1e6 * self.median:.0f}', f'{1e6 * p99:.0f}']


STEP_HEADER = ('step', 'phase', 'median / filter', 'p99 / filter', 'median [us]', 'p99 [us]')

Timed = Callable[[], float]


class Sampled:
    """One sample after the other, with the time of the controller's part of each.

    A sine is applied instead of the command, and the controller is told so: every law in every
    structure works on the same data, whether its own loop is stable or not. Fits are made after
    the command, in `refine`, which is timed on its own. skip: samples that are run beforehand.
    budget_s: of refine, None where it takes as long as it takes.
    """

    def __init__(
        self, parameters: Parameters, skip: int = 0, budget_s: float | None = None,
    ) -> None:
        self._loop = build_closed_loop(parameters)
        self._amplitude = parameters.get_float('amplitude')
        self._frequency = parameters.get_float('frequency')
        self._applied: tuple[float, ...] = ()
        self._budget_s = inf if budget_s is None else budget_s
        self.refined = 0.0  # time of the newest call of refine [s]
        for _ in range(skip):
            self.step()

    @property
    def status(self) -> Status:
        """Of the estimate."""
        return self._loop.controller.estimator.estimate.status

    def step(self) -> float:
        """Run one sample and return the time of the controller's step [s]."""
        loop = self._loop
        controller, plant = loop.controller, loop.plant
        t = plant.sample * loop.sample_period
        y, y_m = plant.measure(), loop.reference(t)
        start = time.perf_counter()
        controller.step(y, y_m, applied=self._applied)
        passed = time.perf_counter() - start
        # A structure that does not feed y back would learn after the command; here it learns at
        # the next step, so that this is timed too.
        late = controller if controller.structure.needs_output else controller.estimator
        start = time.perf_counter()
        late.refine(self._budget_s)
        self.refined = time.perf_counter() - start
        self._applied = (self._amplitude * sin(self._frequency * t),)
        plant.step(*self._applied)
        return passed


def filter_timer() -> Timed | None:
    """A function that runs and times one predict + update of a six-state filter."""
    if not HAS_FILTER:
        return None
    reference = KalmanFilter(dim_x=REFERENCE_STATES, dim_z=1)
    reference.P *= 10.0
    reference.R *= 0.1
    reference.H[0, 0] = 1.0

    def step() -> float:
        start = time.perf_counter()
        reference.predict()
        reference.update(0.1)
        return time.perf_counter() - start

    return step


def interleaved(contestants: Mapping[str, Timed], rounds: int) -> Iterator[tuple[str, Array]]:
    """Times of all contestants, who take turns so that a slow moment of the machine hits all."""
    names = list(contestants)
    times = {name: np.empty(rounds) for name in names}
    for i in range(rounds):
        # Nobody always follows the same neighbour, whose data would be in its cache.
        for name in names[i % len(names):] + names[:i % len(names)]:
            times[name][i] = contestants[name]()
    yield from times.items()


def compare(contestants: dict[str, Timed], phase: str, rounds: int) -> list[Timing]:
    """Timings of the contestants with the filter among them."""
    yardstick = filter_timer()
    entered = dict(contestants)
    if yardstick is not None:
        entered['filter'] = yardstick
    times = dict(interleaved(entered, rounds))
    of_filter = times.pop('filter', None)
    median = None if of_filter is None else float(np.median(of_filter))
    timings = [Timing(name, phase, values, median) for name, values in times.items()]
    if of_filter is not None:
        timings.append(Timing('filterpy, 6 states', phase, of_filter, median))
    return timings


def law_timings() -> list[Timing]:
    """Every law in every structure: steady state and acquisition."""
    settings = {
        f'{law}, {structure}': {
            'estimator.law': law, 'structure': structure, 'output_noise_std': NOISE,
        }
        for structure in STRUCTURES for law in LAWS if law_fits(law, structure)
    }
    steady = compare(
        {what: Sampled(Parameters(s), STEADY_FROM).step for what, s in settings.items()},
        'steady', TIMED,
    )
    default = {what: s for what, s in settings.items() if s['estimator.law'] == DEFAULT}
    parts = [
        compare(
            {what: Sampled(Parameters({**s, 'seed': seed})).step for what, s in default.items()},
            f'first {ACQUISITION} samples', ACQUISITION,
        )
        for seed in range(ACQUISITIONS)
    ]
    return [*steady, *_pooled(parts)[:-1 if HAS_FILTER else None]]


def _pooled(parts: Sequence[list[Timing]]) -> list[Timing]:
    """The same contestants of several comparisons as one."""
    pooled = []
    for same in zip(*parts, strict=True):
        first = same[0]
        yardsticks = [t.yardstick for t in same if t.yardstick is not None]
        yardstick = float(np.median(yardsticks)) if yardsticks else None
        times = np.concatenate([t.times for t in same])
        pooled.append(Timing(first.what, first.phase, times, yardstick))
    return pooled


def order_timings() -> list[Timing]:
    """The default law with G of growing order, exact and with all error terms, steady state."""
    contestants = {}
    for order in ORDERS:
        for uncertainty, word in UNCERTAINTIES.items():
            sampled = Sampled(
                order_example(order).replaced({'plant.uncertainty': uncertainty}), STEADY_FROM
            )
            what = f'{DEFAULT}, {word} G of order {order}'
            if sampled.status != Status.TRACKING:
                what += f' ({sampled.status.name.lower().replace("_", " ")})'
            contestants[what] = sampled.step
    return compare(contestants, 'steady', TIMED)[:-1 if HAS_FILTER else None]


REFINE_HEADER = ('refine', 'samples', 'mean [us]', 'budget [us]', 'longest [us]', 'status')


def refine_rows() -> list[list[str]]:
    """What the fits after the command take: on average, and in one call that has a budget."""
    rows = []
    for structure in STRUCTURES:
        for uncertainty, word in UNCERTAINTIES.items():
            parameters = Parameters({
                'structure': structure, 'output_noise_std': NOISE, 'plant.uncertainty': uncertainty,
            })
            budget_s = REFINE_SHARE * parameters.get_float('sample_period')
            sampled = Sampled(parameters, budget_s=budget_s)
            done = 0
            for until in (ACQUISITION, STEADY_FROM, STEADY_FROM + TIMED):
                times = []
                for _ in range(done, until):
                    sampled.step()
                    times.append(1e6 * sampled.refined)
                rows.append([
                    f'{DEFAULT}, {structure}, {word} G', f'{done} to {until}',
                    f'{np.mean(times):.0f}', f'{1e6 * budget_s:.0f}', f'{max(times):.0f}',
                    sampled.status.name.lower().replace('_', ' '),
                ])
                done = until
    return rows


def order_example(order: int) -> Parameters:
    """The paper's backlash in front of lags of unit gain, y measured to 0.2 % of its swing."""
    poles = np.linspace(0.5, 0.95, order)
    return Parameters({
        'plant.numerator': [float(np.prod(1.0 - poles))],
        'plant.denominator': np.poly(poles).tolist(),
        'output_noise_std': 0.002 * 20.0, 'frequency': 3.14,
    })


def step_checks(timings: Sequence[Timing] | None = None) -> list[Check]:
    """The bounds on a step in units of the filter."""
    by_name = {t.what: t for t in timings or law_timings() if t.phase == 'steady'}
    checks = []
    for (law, structure), limit in MEDIAN_LIMITS.items():
        timing = by_name[f'{law}, {structure}']
        limits = [('median', timing.ratio, limit)]
        if law == DEFAULT:
            limits.append(('p99', timing.p99_ratio, P99_LIMIT))
        checks += [
            Check(
                f'{what} controller step with {law}, {structure} / '
                'predict + update of a six-state filter',
                f'<= {most:g}', MISSING if ratio is None else f'{ratio:.2f}',
                ratio is not None and ratio <= most,
            ) for what, ratio, most in limits
        ]
    return checks
