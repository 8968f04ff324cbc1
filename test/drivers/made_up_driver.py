"""What a driver would send, made up without ROS; and the plant that all tests of it share."""

from math import pi

import numpy as np
from scipy.signal import cont2discrete

from backlash_ros.core import Parameters, build_plant
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.control.motion import Drive
from backlash_ros.core.driver_check import FLOAT64, WRONG, Graph, Heard, Judgement, Message, judge

PERIOD_S = 0.04  # long enough that a busy machine does not disturb it
NATURAL = 2.0 * pi * 2.0  # rad/s
START_NS = 1_800_000_000_000_000_000
REACH, RATE = 5.0, 30.0  # of v
GOOD_GRAPH = Graph(publishers=1, types=(FLOAT64,), listeners=1)


def model(period_s: float = PERIOD_S) -> tuple[list[float], list[float]]:
    continuous = ([NATURAL**2], [1.0, NATURAL, NATURAL**2])
    numerator, denominator, _ = cont2discrete(continuous, period_s, 'zoh')
    return numerator[0, 1:].tolist(), denominator.tolist()


def parameters(**changes: object) -> dict[str, object]:
    """What the driver's user would write into a file; `__` in a name stands for a point."""
    numerator, denominator = model()
    return {
        'sample_period': PERIOD_S, 'plant.numerator': numerator,
        'plant.denominator': denominator, 'estimator.output_noise_std': 1e-3,
        'control.min': -REACH, 'control.max': REACH, 'control.rate_max': RATE,
        **{name.replace('__', '.'): value for name, value in changes.items()}}


def plant_parameters() -> Parameters:
    return Parameters(parameters(
        backlash__m=1.3, backlash__c_r=1.0, backlash__c_l=-0.8, output_noise_std=5e-4))


def messages(values: list[float], offset: float, age_s: float = 1e-4) -> list[Message]:
    stamps = [START_NS + int((k + offset) * PERIOD_S * 1e9) for k in range(len(values))]
    return [
        Message(value, stamp, stamp + int(age_s * 1e9), k + 1)
        for k, (value, stamp) in enumerate(zip(values, stamps, strict=True))]


def heard_from_driver(
    samples: int = 200, delay: int = 0, sign: float = 1.0, reach: float = 1.0,
    rising: bool = False, report: bool = False, limit: float = np.inf,
) -> Heard:
    """What is heard of a driver while v moves.

    delay: samples by which it applies v later. reach: share of REACH that v uses. report: whether
    it publishes applied_control. limit: of v inside the driver. rising: v only rises, from
    0, so that the left side is never engaged.
    """
    limits = Limits(-reach * REACH, reach * REACH, RATE * PERIOD_S)
    drive = Drive(limits, PERIOD_S, samples * PERIOD_S)
    plant = build_plant(plant_parameters())
    v: list[float] = []
    y: list[float] = []
    applied: list[float] = []
    for k in range(samples):
        y.append(sign * plant.measure())
        v.append(reach * REACH * k / samples if rising else drive.step())
        late = v[k - delay] if k >= delay else 0.0
        applied.append(min(max(late, -limit), limit))
        plant.step(applied[-1])
    heard = Heard(messages(y, 0.0), messages(v, 0.1))
    if report:
        heard.applied = messages(applied, 0.99)
    heard.end_ns = heard.outputs[-1].stamp_ns
    return heard


def faults(heard: Heard, graph: Graph = GOOD_GRAPH, **changes: object) -> list[Judgement]:
    # The driver's G is exact, and a fit that may doubt it takes six times as long.
    p = Parameters(parameters(**{'plant__uncertainty': 0.0, **changes}))
    findings = judge(graph, heard, p)
    return [finding for finding in findings if finding.mark == WRONG]


def subjects(findings: list[Judgement]) -> list[str]:
    return [finding.subject for finding in findings]
