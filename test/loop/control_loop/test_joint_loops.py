"""Loops of several joints in one: each is the loop that it would be alone, whatever others do."""

from collections.abc import Callable, Mapping
from math import inf, isnan, nan

import numpy as np

from backlash_ros.core.assembly import first_guess
from backlash_ros.core.loop.control_loop import Driver, JointLoops
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.backlash import Backlash

PERIOD, SAMPLES, FAULTS = 0.01, 4000, 1000
JOINTS = ('waist', 'elbow', 'wrist', 'gripper')
Outputs = dict[str, float]
Spoil = Callable[[int, Outputs], Outputs]


def parameters() -> Parameters:
    values: dict[str, object] = {
        'joints': JOINTS, 'sample_period': PERIOD, 'control.rate_max': 20.0,
        'estimator.law': 'lms', 'estimator.initial.c_r': 0.02, 'estimator.initial.c_l': -0.02,
        'estimator.initial.m': 1.0, 'proportional.f': 0.0}
    for k, joint in enumerate(JOINTS[:-1]):
        pole = 0.5 + 0.1 * k
        values |= {f'{joint}.plant.numerator': [1.0 - pole],
                   f'{joint}.plant.denominator': [1.0, -pole]}
    return Parameters(values)


def run(spoil: Spoil, samples: int = SAMPLES) -> dict[str, list[float]]:
    """Commands of each joint, a number per sample; nan where none was sent."""
    sent: dict[str, list[float]] = {joint: [] for joint in JOINTS}
    newest: dict[str, float] = {}
    def send(commands: Mapping[str, float]) -> None:
        newest.update(commands)
    p = parameters()
    before = {joint: first_guess(p.of_joint(joint)) for joint in JOINTS}
    loops = JointLoops(p, send, lambda joint: Driver(lambda: now_ns), before, SampleCounter(PERIOD))
    plays = {joint: Backlash(1.0, 0.03 + 0.01 * k, -0.04) for k, joint in enumerate(JOINTS)}
    y = dict.fromkeys(JOINTS, 0.0)
    v = dict.fromkeys(JOINTS, 0.0)
    for k in range(samples):
        now_ns = round((1.0 + k * PERIOD) * 1e9)
        loops.take_references({joint: 0.5 * np.sin(0.02 * k + i) for i, joint in enumerate(JOINTS)})
        newest.clear()
        loops.answer({
            joint: Output(value, now_ns, now_ns, now_ns, k, False)
            for joint, value in spoil(k, dict(y)).items()})
        for i, joint in enumerate(JOINTS):
            sent[joint].append(newest.get(joint, nan))
            v[joint] = newest.get(joint, v[joint])
            pole = 0.5 + 0.1 * i
            y[joint] = pole * y[joint] + (1.0 - pole) * plays[joint].step(v[joint])
    return sent


def test_a_thousand_faults_of_a_joint_change_no_command_of_another_by_a_bit() -> None:
    rng = np.random.default_rng(1)
    faults = dict(zip(
        rng.choice(SAMPLES - 1, FAULTS, replace=False) + 1, rng.integers(5, size=FAULTS),
        strict=True))
    def spoil(k: int, y: Outputs) -> Outputs:
        if k not in faults:
            return y
        bad = (nan, inf, 1e200, -3.0)[faults[k]] if faults[k] < 4 else None
        names = list(rng.permutation(JOINTS))
        return {
            name: bad if name == 'elbow' else y[name] for name in names
            if name != 'elbow' or bad is not None}
    alone, beside = run(lambda k, y: y), run(spoil)
    for joint in JOINTS:
        same = np.array_equal(alone[joint], beside[joint], equal_nan=True)
        assert same == (joint != 'elbow')
    unanswered = sum(map(isnan, beside['elbow']))
    assert unanswered == sum(fault != 3 for fault in faults.values())


def test_commands_are_noted_once_the_message_of_all_joints_has_left() -> None:
    now_ns = 1_000_000_000
    def send(commands: Mapping[str, float]) -> None:
        nonlocal now_ns
        assert not any(loop.knows_v for loop in loops.loops)
        now_ns += 2_000_000  # what it takes to publish
    loops = JointLoops(parameters(), send, lambda joint: Driver(
        lambda: now_ns, wall_ns=lambda: now_ns), {}, SampleCounter(PERIOD))
    loops.take_references(dict.fromkeys(JOINTS, 0.1))
    output = Output(0.0, now_ns, now_ns, now_ns, 1, False)
    assert set(loops.answer(dict.fromkeys(JOINTS, output))) == set(JOINTS)
    for loop in loops.loops:
        assert loop.knows_v
        assert loop.commands.newest_ns == now_ns
        assert list(loop.statistics.latencies) == [0.002]
