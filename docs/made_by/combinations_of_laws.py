"""Every law in every structure, also where the command or the samples are not as they should be."""

from collections.abc import Mapping
from math import inf
from typing import NamedTuple

import numpy as np

from backlash_ros.core import Estimate, Parameters, Status, build_closed_loop
from backlash_ros.core.assembly import LAWS, STRUCTURES, law_fits
from backlash_ros.core.estimate import was_given

SAMPLES, RESTS_FROM = 1200, 500
SEED = 5
NOISE = 1e-7  # deviation of the noise on y [unit of y]
LOST = 0.1  # share of the samples
DRIVER_LIMIT = 8.0  # of a driver that limits v by itself [unit of v]
AMPLITUDES = {'proportional': 10.0, 'tracking': 0.2, 'pole_placement': 0.2}
TRUTH = (1.3, 3.0, -3.0)
# Estimates of the laws without deviations are right within this share of m and of the gap, the
# others within so many of their deviations.
RIGHT, DEVIATIONS = 0.2, 5.0


class Condition(NamedTuple):
    """What is not as it should be.

    changes: of parameters. compensates: whether the gap is cancelled. rests: whether y_m stops
    after RESTS_FROM samples. lost: share of the samples that never arrive. driver_limit: beyond
    which the driver limits v by itself; reports: whether it says so on applied_control.
    """

    changes: Mapping[str, object] = {}
    compensates: bool = True
    rests: bool = False
    lost: float = 0.0
    driver_limit: float = inf
    reports: bool = False


CONDITIONS = {
    'all is well': Condition(),
    'compensation off': Condition(compensates=False),
    'v saturated': Condition({'control.min': -8.0, 'control.max': 8.0}),
    'v rate limited': Condition({'control.rate_max': 200.0}),
    'y_m at rest': Condition({'amplitude': 0.0}),
    'y_m comes to rest': Condition(rests=True),
    'samples lost': Condition(lost=LOST),
    'driver limits v, and reports it': Condition(driver_limit=DRIVER_LIMIT, reports=True),
    'driver limits v in silence': Condition(driver_limit=DRIVER_LIMIT),
}


class Sample(NamedTuple):
    """What a sample led to, and the reference that it answered."""

    y_m: float
    u_d: float
    v: float
    estimate: Estimate

    @property
    def claims(self) -> bool:
        return self.estimate.status is Status.TRACKING

    @property
    def is_right(self) -> bool:
        """Whether the estimates are what they are said to be."""
        e, gap = self.estimate, TRUTH[1] - TRUTH[2]
        allowed = DEVIATIONS * np.array([e.std_m, e.std_c_r, e.std_c_l]) if e.learned \
            else RIGHT * np.array([TRUTH[0], gap, gap])
        return bool((np.abs(np.array([e.m, e.c_r, e.c_l]) - TRUTH) <= allowed).all())


def run(law: str, structure: str, condition: Condition) -> list[Sample]:
    """The paper's plant in a loop; raises ParameterError for a combination that cannot work."""
    p = Parameters({
        'estimator.law': law, 'structure': structure, 'output_noise_std': NOISE,
        'amplitude': AMPLITUDES[structure], **condition.changes,
    })
    loop = build_closed_loop(p)
    controller, plant = loop.controller, loop.plant
    controller.compensating = condition.compensates
    rng = np.random.default_rng(SEED)
    samples: list[Sample] = []
    acted: list[float] = []  # since the sample that was answered last
    v = 0.0
    for k in range(SAMPLES):
        y = plant.measure()
        if k == 0 or rng.random() >= condition.lost:
            y_m = 0.0 if condition.rests and k >= RESTS_FROM else loop.reference(k * 0.01)
            reported = acted if condition.reports else ()
            step = controller.step(y, y_m, max(len(acted) - 1, 0), reported)
            controller.refine()
            samples.append(Sample(y_m, step.u_d, step.v, step.estimate))
            v, acted = step.v, []
        acted.append(min(max(v, -condition.driver_limit), condition.driver_limit))
        plant.step(acted[-1])
    return samples


def outcome(samples: list[Sample]) -> str:
    last = samples[-1].estimate
    return 'as given' if was_given(last) else {Status.TRACKING: 'learned'}.get(
        last.status, last.status.word)


def rows() -> tuple[list[str], list[list[str]]]:
    """Header, and a line for each law in each structure that it fits, a column per condition."""
    return ['law, structure', *CONDITIONS], [
        [f'`{law}`, `{structure}`',
         *(outcome(run(law, structure, condition)) for condition in CONDITIONS.values())]
        for structure in STRUCTURES for law in LAWS if law_fits(law, structure)
    ]
