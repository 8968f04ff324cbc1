"""v leaves before the loop does what v need not wait for; what it learns is the same."""

from __future__ import annotations

import pytest

from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters

PERIOD_NS, SAMPLES = 10_000_000, 150
LOST, LATE = {40, 41, 90}, {60, 100}  # outputs that never come, commands that come too late
GIVEN = {
    'plant.uncertainty': 0.0, 'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3,
    'timeout.plant_output': 0.0,
}


class Run:
    """Some samples of a loop. late_reports: the loop asks for them when it has time."""

    def __init__(self, late_reports: bool, **given: object) -> None:
        p = Parameters({**GIVEN, **{name.replace('__', '.'): v for name, v in given.items()}})
        self.sent: list[float] = []
        self.first = 0  # commands that left before their output was taken in
        self._late_reports = late_reports
        self._now_ns = 0
        self._waiting: list[tuple[float, int]] = []  # reports that the loop has not heard
        self.loop = ControlLoop(
            p, self.sent.append, lambda: self._now_ns, None, SampleCounter(0.01),
            reports=self._new_reports,
        )
        self._run(p)

    def _run(self, p: Parameters) -> None:
        plant, reference = build_plant(p), build_reference(p)
        applied = 0.0
        for k in range(SAMPLES):
            stamp_ns = (k + 1) * PERIOD_NS
            y = plant.measure()
            if k not in LOST:
                self.loop.take_reference(reference(0.01 * k))
                self._now_ns = stamp_ns + PERIOD_NS * (11 if k in LATE else 1) // 10
                self._answer(Output(y, stamp_ns, stamp_ns, stamp_ns, k + 1), applied)
                # A limit of the actuator, which the reports alone tell of.
                applied = min(max(self.loop.v, -4.0), 4.0)
            plant.step(applied)

    def _answer(self, output: Output, applied: float) -> None:
        loop = self.loop
        report = applied, output.stamp_ns - 1000
        self.first += loop.answers_first
        if self._late_reports:
            self._waiting.append(report)
        else:
            loop.take_applied(*report)
        loop.answer(output)
        assert not self._waiting
        loop.core.refine()

    def _new_reports(self) -> list[tuple[float, int]]:
        waiting, self._waiting = self._waiting, []
        return waiting


@pytest.mark.parametrize('law', ['moving_horizon', 'lms'])
def test_reports_that_are_taken_after_the_command_teach_the_same(law: str) -> None:
    before, after = (Run(late, estimator__law=law) for late in (False, True))
    assert before.first == after.first == SAMPLES - len(LOST) - 1  # all but the very first one
    assert before.sent == after.sent
    assert before.loop.estimate == after.loop.estimate
    assert before.loop.commands.late == after.loop.commands.late > 0
    assert before.loop.commands.unreported == after.loop.commands.unreported


def test_reports_are_heard_first_where_a_gap_makes_the_loop_begin_again() -> None:
    stamp_ns, back = 0, 40
    loop = ControlLoop(
        Parameters({
            **GIVEN, 'timeout.plant_output': 0.05, 'control.min': -10.0, 'control.max': 10.0,
            'control.rate_max': 10.0,
        }),
        lambda v: None, lambda: stamp_ns, None, SampleCounter(0.01), 0.0,
        reports=lambda: [(2.5, stamp_ns - 1000)] if stamp_ns == back * PERIOD_NS else [],
    )
    loop.take_reference(0.0)
    for k in (1, 2, 3, back):
        stamp_ns = k * PERIOD_NS
        assert abs(loop.v) <= 0.1 * k  # the driver tells of another v in the gap alone
        loop.command(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))
        loop.note()
    assert loop.statistics.interruptions == 1
    assert abs(loop.v - 2.5) <= 0.1 + 1e-9


def test_a_structure_that_needs_y_learns_from_it_first() -> None:
    assert Run(late_reports=True, structure='tracking').first == 0


def test_a_command_leaves_before_its_output_is_counted() -> None:
    counted: list[int] = []
    loop = ControlLoop(
        Parameters(GIVEN), lambda v: counted.append(loop.statistics.used), lambda: 0, None,
        SampleCounter(0.01),
    )
    loop.take_reference(1.0)
    for k in range(1, 4):
        stamp_ns = k * PERIOD_NS
        loop.command(Output(0.0, stamp_ns, stamp_ns, stamp_ns, k))
        loop.note()
    assert counted == [0, 1, 2]
    assert loop.statistics.used == 3
