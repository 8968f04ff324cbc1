"""What a driver, a sensor or a network may do to the loop, one by one and in sequences."""

from math import inf, nan

import numpy as np
import pytest
from fault_loop.fault_controller import blamed
from fault_loop.fault_sequences import Sequence
from simulated_loop import TRUTH, SimulatedLoop

from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters

ABSURD = (nan, inf, -inf, 1e300, -1e300)
RATE_MAX = 400.0
STEP = RATE_MAX * 0.01 * (1.0 + 1e-9)


def test_absurd_numbers_are_dropped_counted_and_change_nothing() -> None:
    world = SimulatedLoop(reports=True, **{'estimator.use_applied_control': 'true'})
    world.learn()
    for i, bad in enumerate(ABSURD, start=1):
        world.loop.take_reference(bad)
        world.driver.applied.append((bad, world.driver.time_ns))
        world.fault = lambda k, output, bad=bad: [output._replace(y=bad)]  # type: ignore[misc]
        world.run(1)
        world.fault = lambda k, output: [output]
        world.run(5)
        assert world.loop.statistics.dropped == 3 * i
        assert world.loop.statistics.bad_outputs == world.loop.statistics.bad_references == i
    world.run(100)
    assert world.error() < 0.02
    world.check_sanity()


@pytest.mark.parametrize(('share', 'published'), [(0.01, False), (0.1, True), (0.3, False)])
def test_lost_outputs_leave_the_estimates_within_5_percent(share: float, published: bool) -> None:
    world = SimulatedLoop()
    def lose(k: int, output: Output) -> list[Output]:
        if world.rng.random() > share:
            return [output]
        world.driver.number -= not published  # then the numbers have no gap
        return []
    world.fault = lose
    world.run(400)
    statistics = world.loop.statistics
    assert statistics.lost == pytest.approx(share * 400.0, rel=0.35, abs=3.0)
    world.learn(0.05)
    assert statistics.unsent == (0 if published else statistics.lost)
    world.check_sanity()


@pytest.mark.parametrize(('share', 'use'), [(0.1, 'true'), (0.3, 'auto')])
def test_lost_controls_that_the_driver_reports_leave_the_estimates_within_5_percent(share, use):
    world = SimulatedLoop(reports=True, **{'estimator.use_applied_control': use})
    world.deaf = lambda: bool(world.rng.random() < share)
    world.run(400)
    assert world.error() < 0.05
    world.check_sanity()


@pytest.mark.parametrize(('origin', 'structure'), [(0.5, 'proportional'), (-4.0, 'tracking')])
def test_reports_of_an_encoder_with_another_zero_still_teach_the_crossings_of_v(origin, structure):
    world = SimulatedLoop(reports=True, structure=structure)
    world.driver.origin = origin
    world.run(600)
    assert world.loop.commands.origin.value == pytest.approx(origin)
    assert world.error() < 0.02
    assert world.rows[-1].status is Status.TRACKING
    world.driver.down_until = world.driver.tick + 200
    world.driver.origin = 0.1
    world.run(800)
    assert world.loop.commands.origin.value == pytest.approx(0.1)
    assert world.error() < 0.02


def test_lost_controls_that_nobody_reports_are_found_or_said_to_be_inconsistent() -> None:
    wrong, learned, far = [], [], []
    for seed in range(1, 15):
        world = SimulatedLoop()
        world.learn()
        world.rng = np.random.default_rng(seed)
        world.deaf = lambda world=world: bool(world.rng.random() < 0.3)
        world.run(600)
        rows = world.rows[-600:]
        inconsistent = np.mean([row.status is Status.INCONSISTENT for row in rows])
        assert inconsistent > 0.2 or world.loop.core.estimator.report.reattributed > 50
        off = np.abs([[row.m, row.c_r, row.c_l] for row in rows] - TRUTH)
        beyond = off > 5.0 * np.array([[row.std_m, row.std_c_r, row.std_c_l] for row in rows])
        # In one of ten intervals an older command acted, which nothing explains: this matters where
        # it moves a crossing by a hundredth of the gap.
        matters = (off[:, 1:] > 0.01 * (TRUTH[1] - TRUTH[2])).any(axis=1)
        tracking = np.array([row.status is Status.TRACKING for row in rows])
        wrong.append(np.mean(tracking & beyond.any(axis=1) & matters))
        learned.append(tracking[-1])
        # In some runs, swaps that did not happen explain as much as those that did.
        far.append((off / np.abs(TRUTH)).max())
        world.check_sanity()
    assert np.sum(np.array(far) > 0.05) <= 4
    assert max(far) < 0.3
    assert np.mean(learned) > 0.5
    assert np.mean(wrong) < 0.02


@pytest.mark.parametrize('broken', ['sign', 'constant'])
def test_a_broken_sensor_contradicts_and_the_last_good_estimates_are_held(broken: str) -> None:
    world = SimulatedLoop()
    world.learn()
    world.sensor.fault, world.sensor.value = broken, world.sensor.last
    world.run(200)
    assert world.rows[-1].status == Status.INCONSISTENT
    held = [(row.m, row.c_r, row.c_l) for row in world.rows[-50:]]
    assert len(set(held)) == 1
    assert world.error() < 0.05
    world.check_sanity()


def flood(k: int, output: Output) -> list[Output]:
    first = 20 * output.sequence
    return [output._replace(stamp_ns=output.stamp_ns + 1000 * i, sequence=first + i)
            for i in range(20)]


def with_stranger(k: int, output: Output) -> list[Output]:
    later = output.stamp_ns + 4_000_000
    return [output, output._replace(y=3.0 - output.y, stamp_ns=later, sequence=k)]


@pytest.mark.parametrize(('fault', 'samples', 'extra', 'number'), [
    (flood, 50, range(19 * 45, 20 * 50), 20), (with_stranger, 200, range(200, 201), 1),
])
def test_a_flood_or_a_second_driver_is_not_answered_and_leaves_nothing(
    fault, samples, extra, number,
):
    world = SimulatedLoop()
    world.learn()
    world.fault = fault
    before = len(world.sent)
    world.run(samples)
    assert len(world.sent) - before <= 1.1 * samples
    assert world.loop.statistics.extra in extra
    assert number > 1 or world.error() < 0.02
    world.fault = lambda k, output: [output]
    world.driver.number *= number
    world.run(200)
    assert world.error() < 0.05
    world.check_sanity()


STANDING = 5.13  # v at which the driver is found


@pytest.mark.parametrize(('reports', 'initial'), [(True, None), (True, -3.0), (False, STANDING)])
def test_the_first_command_goes_on_from_what_is_known_of_v(reports, initial):
    world = SimulatedLoop(reports, initial, **{'control.rate_max': RATE_MAX})
    world.driver.actuator.v = STANDING
    world.run(100)
    assert np.abs(np.diff([STANDING, *world.sent])).max() <= STEP


@pytest.mark.parametrize(('jump_s', 'own', 'its', 'interruptions', 'lost'), [
    *((jump_s, True, True, 0, 0) for jump_s in (3600.0, 0.1, 0.004, -0.004, -0.2)),
    *((jump_s, True, False, 0, 0) for jump_s in (0.21, -0.2)),
    (0.21, False, True, 1, 21), (-0.2, False, True, 1, 0), (0.1, False, True, 0, 10),
])
def test_a_clock_that_is_set_counts_only_on_another_machine(jump_s, own, its, interruptions, lost):
    world = SimulatedLoop(**{'estimator.law': 'fixed', 'timeout.plant_output': 0.2})
    world.run(100)
    jump_ns = round(jump_s * 1e9)
    world.driver.offset_ns += jump_ns * own
    off_ns = jump_ns * (its - own)
    world.fault = lambda k, output: [output._replace(stamp_ns=output.stamp_ns + off_ns)]
    world.run(100)
    statistics = world.loop.statistics
    assert (statistics.interruptions, statistics.lost) == (interruptions, lost)
    assert statistics.extra <= 4 * (not own)  # that are dismissed


def test_a_driver_that_repeats_outputs_from_the_start_is_counted_anew() -> None:
    world = SimulatedLoop(**{'estimator.law': 'fixed'})
    world.driver.repeats = True
    world.run(200)
    assert world.loop.statistics.interruptions == 1
    before = world.loop.counter.index
    world.run(100)
    assert world.loop.counter.index == before + 100


def test_a_take_up_rate_that_is_set_live_is_how_fast_v_crosses_the_gap() -> None:
    world = SimulatedLoop()
    world.learn()
    world.controller.take_up(world.p.replaced({'inverse.take_up_rate': 50.0}))
    begun = len(world.sent)
    world.run(100)
    moves = np.abs(np.diff(world.sent[begun:]))
    # The gap is 6 wide and is crossed four times in these two periods, by half a unit in a sample.
    assert 40 < np.isclose(moves, 0.5, atol=1e-9).sum() < 52


# In 188 limits change while v is led to zero, in 6351 v is on its way over the gap; in 13592 and
# 15977 others leave v far out, for `tracking` and `proportional`; in 17291 an `lms` that was at the
# bound of m is interrupted.
@pytest.mark.parametrize('seed', [2, 188, 6351, 13592, 15977, 17291])
@pytest.mark.filterwarnings('ignore')
def test_no_sequence_of_faults_breaks_a_limit_or_makes_v_jump(seed: int) -> None:
    sequence = Sequence(seed)
    found = sequence.run()
    assert sequence.commands > 0
    assert [found[kind] for kind in ('outside', 'too_fast', 'jumps', 'unbounded')] == [[]] * 4


@pytest.mark.parametrize('seed', [113, 206, 269, 1013, 2510])
@pytest.mark.filterwarnings('ignore')
def test_saved_estimates_of_another_plant_are_never_said_to_track(seed: int) -> None:
    assert Sequence(seed).run()['wrong_inherited'] == []


# A G that jumps where its lag does, two plays that explain y as well as each other, and another G
# with another play that explains it as well as the nominal G does (3954, 4064). In 13753 and 18494
# fits that begin near one of the two lose their way.
@pytest.mark.parametrize('seed', [2009, 2207, 3954, 4064, 13753, 18494])
@pytest.mark.filterwarnings('ignore')
def test_one_of_two_explanations_is_not_said_to_track(seed: int) -> None:
    assert Sequence(seed).run()['wrong'] == []


@pytest.mark.parametrize('seed', [5161, 12478])
@pytest.mark.filterwarnings('ignore')
def test_zeros_that_move_with_the_poles_leave_no_wrong_estimate(seed: int) -> None:
    assert Sequence(seed).run()['wrong_uncertain'] == []


@pytest.mark.filterwarnings('ignore')
def test_samples_that_nothing_explains_make_no_fit_fail() -> None:
    assert Sequence(3444).run()['failed'] == []  # a flipped sensor: all fits diverge


PERIOD_NS = 10_000_000
MOVE = 0.5  # at most, from sample to sample


def first_command(heard_at: int, reported_at: int) -> float:
    """v after another controller commanded 4.0, and the driver reported -4.0, at these samples."""
    now = [0]
    p = Parameters({'control.min': -10.0, 'control.max': 10.0, 'control.rate_max': 100.0 * MOVE})
    loop = ControlLoop(
        p, Driver(lambda: now[0] * PERIOD_NS), None, SampleCounter(0.01, from_zero=False), 0.0)
    def answer(k: int) -> float:
        now[0] = k
        stamp_ns = k * PERIOD_NS
        loop.take_reference(0.0)
        output = Output(0.0, stamp_ns, stamp_ns, stamp_ns, k)
        step = loop.answer(output)
        assert step is not None
        loop.note_answer(step, output)
        return step.v
    answer(1)
    loop.stand_down()
    for k in range(2, 8):
        now[0] = k
        if k == heard_at:
            loop.hear_other(4.0)
        if k == reported_at:
            loop.take_applied(-4.0, k * PERIOD_NS - 1)
    loop.resume()
    return answer(8)


@pytest.mark.parametrize(('heard_at', 'v'), [(7, 4.0), (5, -4.0)])
def test_v_goes_on_from_the_newest_of_a_command_and_a_report_at_7(heard_at, v):
    assert abs(first_command(heard_at, reported_at=7) - v) <= MOVE


def test_reports_are_heard_first_where_a_gap_makes_the_loop_begin_again() -> None:
    stamp_ns, back = 0, 40
    loop = ControlLoop(
        Parameters({
            'timeout.plant_output': 0.05, 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 10.0}),
        Driver(lambda: stamp_ns), None, SampleCounter(0.01), 0.0)
    loop.take_reference(0.0)
    for k in (1, 2, 3, back):
        stamp_ns = k * PERIOD_NS
        assert abs(loop.v) <= 0.1 * k  # the driver tells of another v in the gap alone
        if k == back:
            loop.take_applied(2.5, stamp_ns - 1000)
        output = Output(0.0, stamp_ns, stamp_ns, stamp_ns, k)
        step = loop.answer(output)
        assert step is not None
        loop.note_answer(step, output)
    assert loop.statistics.interruptions == 1
    assert abs(loop.v - 2.5) <= 0.1 + 1e-9


NOISY = {'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3, 'plant.uncertainty': 0.2}


@pytest.mark.parametrize(('hz', 'slow', 'structure', 'said'), [
    (50.0, 0.09, 'tracking', 'plant_output comes at 45.'),
    (100.0, 0.005, 'proportional', 'plant_output comes at 99.'),
    (500.0, 0.06, 'proportional', 'plant_output comes at 47'),
    (200.0, 0.003, 'tracking', ''),
])
def test_of_a_slow_driver_its_rate_is_named_and_nothing_else(hz, slow, structure, said) -> None:
    wave = {'frequency': 0.126 * hz, 'structure': structure}
    texts, kinds = blamed(hz, slow, 0.05, 4.0 + 200.0 / hz, {**NOISY, **wave})
    assert set(kinds) == ({'rate'} if said else set())
    assert all(text.startswith(said) for text in texts)
    assert len(texts) >= 3 * bool(said)
