"""Time of one whole controller step, beside one predict + update of filterpy's KalmanFilter."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import sin

import numpy as np
from numpy.typing import NDArray
from reporting import Check

from backlash_ros.core.assembly import build_state_model
from backlash_ros.core.closed_loop import build_closed_loop
from backlash_ros.core.estimation.protocol import Status
from backlash_ros.core.gap_bank import GapBank, Noise, Prior
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.run_record import RunRecord

try:
    from filterpy.kalman import KalmanFilter  # type: ignore[import-untyped]
except ImportError:
    KalmanFilter = None
HAS_FILTER = KalmanFilter is not None

Array = NDArray[np.float64]

LAWS = ('kalman', 'lms', 'printed', 'fixed')
STRUCTURES = ('proportional', 'tracking')
ORDERS = (2, 4, 8)
HYPOTHESES = (1, 7, 22, 44, 88)
ACQUISITION, STEADY_FROM, TIMED = 100, 600, 2000  # samples
ACQUISITIONS = 10  # runs, each with its own seed
KALMAN_LIMIT, LMS_LIMIT = 3.5, 0.5  # in units of one predict + update
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
    def row(self) -> list[str]:
        """Cells: what, phase, ratio of the median, ratio of p99, microseconds of both."""
        p99 = float(np.quantile(self.times, 0.99))
        ratios = ['-', '-'] if self.yardstick is None else [
            f'{self.median / self.yardstick:.2f}', f'{p99 / self.yardstick:.2f}']
        return [self.what, self.phase, *ratios, f'{1e6 * self.median:.0f}', f'{1e6 * p99:.0f}']


STEP_HEADER = ('step', 'phase', 'median / filter', 'p99 / filter', 'median [us]', 'p99 [us]')

Timed = Callable[[], float]


def step_timer(parameters: Parameters, skip: int = 0) -> tuple[Timed, Callable[[], Status]]:
    """A function that runs one sample and returns the time of the controller's part, and one
    that tells the status; `skip` samples are run beforehand.

    A sine is applied instead of the command, and the controller is told so: every law in every
    structure works on the same data, whether its own loop is stable or not.
    """
    loop = build_closed_loop(parameters)
    controller, plant = loop.controller, loop.plant
    amplitude, frequency = parameters.real('amplitude'), parameters.real('frequency')
    applied: tuple[float, ...] = ()

    def step() -> float:
        nonlocal applied
        t = plant.sample * loop.sample_period
        y, y_m = plant.measure(), loop.reference(t)
        start = time.perf_counter()
        controller.step(y, y_m, applied=applied)
        passed = time.perf_counter() - start
        applied = (amplitude * sin(frequency * t),)
        plant.step(*applied)
        return passed

    for _ in range(skip):
        step()
    return step, lambda: controller.estimator.estimate.status


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
        for structure in STRUCTURES for law in LAWS
    }
    steady = compare(
        {what: step_timer(Parameters(s), STEADY_FROM)[0] for what, s in settings.items()},
        'steady', TIMED,
    )
    kalman = {what: s for what, s in settings.items() if s['estimator.law'] == 'kalman'}
    parts = [
        compare(
            {what: step_timer(Parameters({**s, 'seed': seed}))[0] for what, s in kalman.items()},
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
    """The law kalman with G of growing order, steady state."""
    contestants = {}
    for order in ORDERS:
        step, status = step_timer(order_example(order), STEADY_FROM)
        what = f'kalman, G of order {order}'
        if status() != Status.TRACKING:
            what += f' ({status().name.lower().replace("_", " ")})'
        contestants[what] = step
    return compare(contestants, 'steady', TIMED)[:-1 if HAS_FILTER else None]


def order_example(order: int) -> Parameters:
    """The paper's backlash in front of lags of unit gain, y measured to 0.2 % of its swing."""
    poles = np.linspace(0.5, 0.95, order)
    return Parameters({
        'plant.numerator': [float(np.prod(1.0 - poles))],
        'plant.denominator': np.poly(poles).tolist(),
        'output_noise_std': 0.002 * 20.0, 'frequency': 3.14,
    })


def bank_timings() -> list[Timing]:
    """One predict + correct of the bank alone with a growing number of hypotheses."""
    parameters = Parameters({})
    run = build_closed_loop(parameters).run(STEADY_FROM)
    contestants = {
        f'bank of {count} hypotheses, order 3': _bank_timer(parameters, count, run)
        for count in HYPOTHESES
    }
    return compare(contestants, 'steady', STEADY_FROM // 2)[:-1 if HAS_FILTER else None]


def _bank_timer(parameters: Parameters, count: int, run: RunRecord) -> Timed:
    model = build_state_model(parameters)
    prior = Prior(np.array([1.0, 1.0, -1.0]), 10.0)
    bank = GapBank(np.geomspace(0.1, 6.0, count + 1)[1:], model, prior, Noise(NOISE))
    v, y = run.column('v').tolist(), run.column('y').tolist()
    k = 0

    def step() -> float:
        nonlocal k
        k += 1
        start = time.perf_counter()
        bank.predict(v[k - 1])
        bank.correct(y[k])
        return time.perf_counter() - start

    # All hypotheses start within the first period; from then on every one of them costs.
    for _ in range(STEADY_FROM // 2 - 1):
        step()
    return step


def step_checks(timings: Sequence[Timing] | None = None) -> list[Check]:
    """The bounds on the median step in units of the filter."""
    by_name = {t.what: t for t in timings or law_timings() if t.phase == 'steady'}
    checks = []
    for law, limit in (('kalman', KALMAN_LIMIT), ('lms', LMS_LIMIT)):
        ratio = by_name[f'{law}, proportional'].ratio
        checks.append(Check(
            f'median controller step with {law} / predict + update of a six-state filter',
            f'<= {limit:g}', MISSING if ratio is None else f'{ratio:.2f}',
            ratio is not None and ratio <= limit,
        ))
    return checks
