"""A gear made of physics with the commands of a user: identified from its limits, then followed."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / 'benchmarks'), str(ROOT / 'examples')]

from gears import gear_runs  # noqa: E402
from gears.gear_processes import MOST_LOST, MOTION, GearProcesses, TooBusyError  # noqa: E402

DRIVE_S, PERIODS = 6.0, 3
SLOWER = 'sample_period=0.01'  # than the preset: beside other tests a machine has less time
REMOVED = 0.8


def test_from_its_limits_to_a_loop_that_removes_what_backlash_does(tmp_path: Path) -> None:
    servo = GearProcesses('servo', tmp_path, SLOWER)
    try:
        found, lost = servo.identify(DRIVE_S), servo.gear.lost_motion
    except TooBusyError as error:
        pytest.skip(f'on this machine, now, {error}')
    assert found['usable'], found['reasons']
    assert found['gap'] == pytest.approx(lost, rel=0.05)
    learned = servo.follow('learned', periods=PERIODS)
    if learned.lost + learned.late > MOST_LOST:
        pytest.skip(f'lost samples: {learned.lost:.0%}, late commands: {learned.late:.0%}')
    none, known = (
        servo.as_read(gear_runs.close_loop(servo.gear, controller, MOTION).error)
        for controller in (
            gear_runs.constant(servo.parameters, 1.0, 0.0, 0.0, gear_runs.DOUBT),
            gear_runs.constant(servo.parameters, 1.0, 0.5 * lost, -0.5 * lost),
        )
    )
    assert none > 2.0 * known
    assert (none - learned.error) / (none - known) > REMOVED
    assert learned.gap == pytest.approx(lost, rel=0.1)
