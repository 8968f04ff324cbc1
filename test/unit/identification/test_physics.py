"""A gear that MuJoCo integrates: its play is the one that was asked for, and it is cancelled."""

import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from contract.situation_rows import run_gears
from gear_physics import PRESETS
from gears import gear_runs

from backlash_ros.core.estimate import Status

SERVO = PRESETS['servo']


@pytest.fixture(scope='module')
def identified() -> gear_runs.Identified:
    return gear_runs.identified(SERVO, encoder=False)


def test_identified_from_limits_alone_the_loop_removes_what_backlash_does(identified):
    assert (identified.refused, identified.found.reasons) == ('', ())
    assert identified.parameters is not None
    lost = SERVO.lost_motion
    assert identified.found.gap == pytest.approx(lost, rel=0.05)
    run = gear_runs.close_loop(SERVO, identified.controller, 'sine', periods=3)
    none = gear_runs.uncompensated(SERVO, identified.parameters, 'sine').error
    known = gear_runs.constant(identified.parameters, 1.0, 0.5 * lost, -0.5 * lost)
    best = gear_runs.close_loop(SERVO, known, 'sine', periods=2, first=1).error
    assert none > 5.0 * best
    assert (none - run.error) / (none - best) > 0.9
    assert run.status[-1] == Status.TRACKING
    assert run.said_tracking_off_by(lost) < 0.05


def test_what_was_identified_serves_a_motion_with_other_turns(identified):
    assert identified.parameters is not None
    run = gear_runs.close_loop(SERVO, identified.controller, 'triangle', periods=3)
    none = gear_runs.uncompensated(SERVO, identified.parameters, 'triangle').error
    assert run.error < 0.25 * none


def test_a_fit_that_takes_g_far_from_its_prior_does_not_replace_what_was_identified():
    runs = run_gears('cnc')
    assert all(run.usable for run in runs)
    assert not any(run.wrong for run in runs)
