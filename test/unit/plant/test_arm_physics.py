"""An arm that MuJoCo integrates: what each joint loses is its gap and its wind-up."""

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')

from arm_physics import JOINTS, RESOLUTION, ArmPhysics

PERIOD, SAMPLE = 16.0, 0.01  # [s]


def hysteresis(arm: ArmPhysics) -> NDArray[np.float64]:
    """What each joint loses in a slow motion to and fro of all [rad]."""
    servo, phase = arm.servo, 0.9 * np.arange(len(arm.joints))
    omega, lost = 2.0 * np.pi / PERIOD, []
    for k in range(int(1.5 * PERIOD / SAMPLE)):
        angle = omega * SAMPLE * k + phase
        ramp = min(2.0 * k * SAMPLE / PERIOD, 1.0)
        arm.move_to(0.2 * ramp * np.sin(angle))
        arm.advance(SAMPLE)
        # A position loop with damping and no integrator lags by damping / stiffness.
        lag = servo.damping / servo.stiffness * 0.2 * omega * np.cos(angle)
        lost.append(arm.data.ctrl - lag - arm.links)
    return np.ptp(lost[len(lost) // 3:], axis=0)


def test_each_joint_loses_its_gap_and_the_wind_up_of_its_servo() -> None:
    arm = ArmPhysics()
    assert hysteresis(arm) == pytest.approx([arm.lost_motion(one) for one in JOINTS], rel=0.08)


def test_tip_is_where_the_joints_put_it_and_encoders_have_twelve_bits() -> None:
    arm = ArmPhysics()
    arm.move_to([0.5, -0.3, 0.4, 0.2, -0.1, 0.3])
    arm.advance(0.5)
    assert np.linalg.norm(arm.tip_at(np.zeros(6)) - arm.tip) > 0.1
    assert arm.tip == pytest.approx(arm.data.site_xpos[0], abs=1e-4)
    steps = np.array(arm.encoders()) / RESOLUTION
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    assert arm.encoders() == pytest.approx(arm.links, abs=0.51 * RESOLUTION)
