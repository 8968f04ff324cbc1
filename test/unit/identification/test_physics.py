"""A gear that MuJoCo integrates: its play is the one that was asked for, and it is cancelled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from gear_physics import PRESETS
from gears import gear_runs

from backlash_ros.core.estimate import Status

SERVO = PRESETS['servo']


@pytest.fixture(scope='module')
def identified() -> gear_runs.Identified:
    """The servo, identified from its limits alone."""
    return gear_runs.identified(SERVO, encoder=False)


def test_identified_from_limits_alone_the_loop_removes_what_backlash_does(
    identified: gear_runs.Identified,
) -> None:
    assert identified.said == 'of use'
    assert identified.parameters is not None
    lost = SERVO.lost_motion
    assert identified.found.gap == pytest.approx(lost, rel=0.05)
    run = gear_runs.close_loop(
        SERVO, gear_runs.learning(identified.found, identified.parameters), 'sine', periods=3
    )
    none = gear_runs.uncompensated(SERVO, identified.parameters, 'sine').error
    known = gear_runs.constant(identified.parameters, 1.0, 0.5 * lost, -0.5 * lost)
    best = gear_runs.close_loop(SERVO, known, 'sine', periods=2, first=1).error
    assert none > 5.0 * best
    assert (none - run.error) / (none - best) > 0.9
    assert run.status[-1] == Status.TRACKING
    assert run.said_tracking_off_by(lost) < 0.05


def test_from_the_motor_encoder_lag_and_wind_up_of_the_motor_are_made_up_for_as_well() -> None:
    identified = gear_runs.identified(SERVO, encoder=True)
    assert identified.said == 'of use'
    parameters, actuator = identified.parameters, identified.found.actuator
    assert parameters is not None
    assert actuator is not None
    behind_motor = SERVO.gap + 2.0 * SERVO.friction / SERVO.contact_stiffness
    assert identified.found.gap == pytest.approx(behind_motor, rel=0.03)
    assert sum(actuator.wind_up) == pytest.approx(
        2.0 * SERVO.friction / SERVO.stiffness, rel=0.05
    )
    assert parameters['estimator.use_applied_control'] == 'true'
    run = gear_runs.close_loop(
        SERVO, gear_runs.learning(identified.found, parameters), 'sine', encoder=True, periods=3
    )
    # As well as with the best constants from the command, 2 % of the motion that is lost; without
    # compensation it is 30 %.
    assert run.error < 0.035 * SERVO.lost_motion


def test_one_speed_with_rests_takes_nothing_from_what_was_identified(
    identified: gear_runs.Identified,
) -> None:
    # At each rest, and at 1,500 samples, the record is let go; the rest of it takes a lag of the
    # position loop for a part of the gap.
    assert identified.parameters is not None
    gear = replace(SERVO, frequency=1.1 * SERVO.frequency)
    controller = gear_runs.learning(identified.found, identified.parameters)
    run = gear_runs.close_loop(gear, controller, 'moves and rests')
    assert np.abs(run.gap / identified.found.gap - 1.0).max() < 0.02
    assert run.error < 0.1 * SERVO.lost_motion
