"""Sequences of faults as benchmarks/faults.py plays them, interruptions, drivers that are slow."""

import pytest
from fault_loop.fault_controller import blamed
from fault_loop.fault_sequences import Sequence

from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters


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


@pytest.mark.parametrize('seed', [113, 206, 269])
@pytest.mark.filterwarnings('ignore')
def test_saved_estimates_of_another_plant_are_never_said_to_track(seed: int) -> None:
    assert Sequence(seed).run()['wrong_inherited'] == []


PERIOD_NS = 10_000_000
MOVE = 0.5  # at most, from sample to sample


def first_command(heard_at: int, reported_at: int) -> float:
    """v after another controller commanded 4.0, and the driver reported -4.0, at these samples."""
    sent: list[float] = []
    now = [0]
    p = Parameters({'control.min': -10.0, 'control.max': 10.0, 'control.rate_max': 100.0 * MOVE})
    loop = ControlLoop(
        p, sent.append, Driver(lambda: now[0] * PERIOD_NS), None,
        SampleCounter(0.01, from_zero=False), 0.0,
    )

    def answer(k: int) -> None:
        now[0] = k
        stamp_ns = k * PERIOD_NS
        loop.take_reference(0.0)
        loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))

    answer(1)
    loop.stand_down()
    for k in range(2, 8):
        now[0] = k
        if k == heard_at:
            loop.hear_other(4.0)
        if k == reported_at:
            loop.take_applied(-4.0, k * PERIOD_NS - 1)
    loop.resume()
    answer(8)
    return sent[-1]


@pytest.mark.parametrize(('heard_at', 'v'), [(7, 4.0), (5, -4.0)])
def test_v_goes_on_from_the_newest_of_a_command_and_a_report_at_7(heard_at, v):
    assert abs(first_command(heard_at, reported_at=7) - v) <= MOVE


def test_reports_are_heard_first_where_a_gap_makes_the_loop_begin_again() -> None:
    stamp_ns, back = 0, 40
    loop = ControlLoop(
        Parameters({
            'timeout.plant_output': 0.05, 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 10.0,
        }),
        lambda v: None, Driver(lambda: stamp_ns), None, SampleCounter(0.01), 0.0,
    )
    loop.take_reference(0.0)
    for k in (1, 2, 3, back):
        stamp_ns = k * PERIOD_NS
        assert abs(loop.v) <= 0.1 * k  # the driver tells of another v in the gap alone
        if k == back:
            loop.take_applied(2.5, stamp_ns - 1000)
        loop.answer(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))
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
