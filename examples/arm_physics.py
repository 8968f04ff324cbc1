"""A small arm with six servos on a bus, a gap behind each of them, as MuJoCo integrates it; no ROS.

Each joint is the actuator of gear_physics.py: a motor with its position loop, a gap that is elastic
where it closes, then the link with dry friction and an encoder of 12 bits. Motors sit on the link
before theirs, so that joints disturb each other as they do in an arm. SI units, angles in rad.

The figures are published ones of arms of this kind, the arm as a whole is nobody's:

servo    0.028 kg m^2, 17.8 Nm/rad, 0.60 Nms/rad, 0.052 Nm of dry friction: the STS3215 in the model
         of the SO-101 (https://github.com/TheRobotStudio/SO-ARM100, Simulation/SO101, class
         sts3215), 30 kg cm and 12 bits: its data sheet. Contact as in the preset servo.
play     8.75 steps of the encoder, 0.77 degrees, in the base of a SO-ARM 101, 5.0 in that of a
         SO-ARM 102 (https://github.com/roboninecom/SO-ARM-102, docs/specifications.md), about 1
         degree at a servo (https://github.com/TheRobotStudio/SO-ARM100/issues/134); the model of
         the SO-101 has +-0.5 degrees in every joint (class backlash).
links    masses and lengths of the SO-ARM100 to a few percent, in the forearm a sixth joint and its
         servo, which the WidowX-250s has there (https://github.com/google-deepmind/mujoco_menagerie,
         trs_so_arm100 and trossen_wx250s).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import mujoco
import numpy as np
from gear_physics import DEGREE, STEP_S, STICK, rounded, set_contact
from numpy.typing import NDArray

RESOLUTION = 2.0 * pi / 2**12  # of the encoders


@dataclass(frozen=True)
class Servo:
    """Constants of a servo and its gear; see Gear in gear_physics.py."""

    motor_inertia: float = 0.028
    stiffness: float = 17.8
    damping: float = 0.60
    torque_limit: float = 2.9
    friction: float = 0.052
    viscous: float = 0.005
    contact_stiffness: float = 164.0
    contact_damping: float = 0.15


@dataclass(frozen=True)
class Joint:
    """A joint and the link behind it.

    gap: play [rad]. axis: letter of the axis it turns about. at: where it is on the link before
    [m]. to: where the link ends, from the joint [m]. mass: of the link [kg].
    """

    name: str
    gap: float
    axis: str
    at: tuple[float, float, float]
    to: tuple[float, float, float]
    mass: float


JOINTS = (
    Joint('waist', 0.77 * DEGREE, 'z', (0.0, 0.0, 0.06), (0.0, 0.0, 0.06), 0.12),
    Joint('shoulder', 0.90 * DEGREE, 'y', (0.0, 0.0, 0.06), (0.03, 0.0, 0.113), 0.16),
    Joint('elbow', 1.00 * DEGREE, 'y', (0.03, 0.0, 0.113), (0.07, 0.0, 0.0), 0.12),
    Joint('forearm_roll', 0.70 * DEGREE, 'x', (0.07, 0.0, 0.0), (0.065, 0.0, 0.0), 0.09),
    Joint('wrist_pitch', 0.80 * DEGREE, 'y', (0.065, 0.0, 0.0), (0.06, 0.0, 0.0), 0.066),
    Joint('wrist_roll', 0.60 * DEGREE, 'x', (0.06, 0.0, 0.0), (0.10, 0.0, 0.03), 0.11),
)
AXES = {'x': '1 0 0', 'y': '0 1 0', 'z': '0 0 1'}


class ArmPhysics:
    """The arm in motion, beginning at rest with every joint at 0 in the middle of its gap.

    balance: share of the weight that springs carry at the links. Where a servo has to carry more
    than the dry friction of its joint, the weight holds its gap closed: nothing is lost there.
    """

    def __init__(
        self, joints: Sequence[Joint] = JOINTS, servo: Servo | None = None, balance: float = 1.0,
    ) -> None:
        self.joints, self.servo = tuple(joints), servo or Servo()
        self.model = mujoco.MjModel.from_xml_string(_description(joints, self.servo, balance))
        set_contact(self.model, self.servo.contact_stiffness, self.servo.contact_damping)
        self.data = mujoco.MjData(self.model)
        self._ideal = mujoco.MjData(self.model)  # for where the tip belongs
        self._motors = [self._row(f'{one.name}_motor') for one in joints]
        self._links = [self._row(one.name) for one in joints]
        self._gain = self.model.actuator_gainprm.copy()
        self._bias = self.model.actuator_biasprm.copy()

    def lost_motion(self, joint: Joint) -> float:
        """Gap and wind-up by dry friction [rad]."""
        servo = self.servo
        return joint.gap + 2.0 * servo.friction * (
            1.0 / servo.stiffness + 1.0 / servo.contact_stiffness
        )

    def move_to(self, v: Sequence[float]) -> None:
        """Command all motors [rad]."""
        self.data.ctrl[:] = v

    def set_torque(self, joint: int, on: bool) -> None:
        """Switch the position loop of a motor on or off."""
        self.model.actuator_gainprm[joint] = self._gain[joint] if on else 0.0
        self.model.actuator_biasprm[joint] = self._bias[joint] if on else 0.0

    def advance(self, seconds: float) -> None:
        """Integrate, a whole number of STEP_S."""
        mujoco.mj_step(self.model, self.data, round(seconds / STEP_S))

    @property
    def motors(self) -> NDArray[np.float64]:
        """Positions of the motors as they are [rad], shape (joints,)."""
        return np.array(self.data.qpos[self._motors])

    @property
    def links(self) -> NDArray[np.float64]:
        """Positions of the joints as they are [rad], shape (joints,)."""
        return np.array(self.data.qpos[self._links])

    @property
    def speeds(self) -> NDArray[np.float64]:
        """Speeds of the joints [rad/s], shape (joints,)."""
        return np.array(self.data.qvel[self._links])

    def encoders(self) -> list[float]:
        """Positions of the joints as they are measured [rad]."""
        return [rounded(float(one), RESOLUTION) for one in self.links]

    @property
    def tip(self) -> NDArray[np.float64]:
        """Where the tip is [m], shape (3,)."""
        return self.tip_at(self.links)

    def tip_at(self, positions: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the tip belongs with the joints at positions [rad]; [m], shape (3,)."""
        self._ideal.qpos[self._links] = positions
        mujoco.mj_kinematics(self.model, self._ideal)
        return np.array(self._ideal.site_xpos[0])

    def _row(self, joint: str) -> int:
        return int(self.model.joint(joint).qposadr[0])


def _description(joints: Sequence[Joint], servo: Servo, balance: float) -> str:
    """The model in the language of MuJoCo; links are rods."""
    link = f'<site name="tip" pos="{_text(joints[-1].to)}" size=".006" rgba=".9 .2 .1 1"/>'
    for one in reversed(joints):
        axis = AXES[one.axis]
        # The armature is the inertia of the rotor as the joint feels it; nothing else does.
        link = f"""
<body name="{one.name}_motor" pos="{_text(one.at)}" gravcomp="{balance}">
  <joint name="{one.name}_motor" axis="{axis}" armature="{servo.motor_inertia}"/>
  <geom type="cylinder" size=".012 .014" zaxis="{axis}" mass="1e-6" rgba=".9 .5 .1 1"/>
</body>
<body name="{one.name}" pos="{_text(one.at)}" gravcomp="{balance}">
  <joint name="{one.name}" axis="{axis}" damping="{servo.viscous}" frictionloss="{servo.friction}"
         solreffriction="{2.0 * STEP_S} 1" solimpfriction="{STICK} {STICK} 1 0.5 2"/>
  <geom type="capsule" fromto="0 0 0 {_text(one.to)}" size=".018" mass="{one.mass}"
        rgba=".6 .65 .7 1"/>
  {link}
</body>"""
    gaps = '\n'.join(f"""
<fixed name="{one.name}_gap" limited="true" range="{-0.5 * one.gap} {0.5 * one.gap}">
  <joint joint="{one.name}_motor" coef="1"/>
  <joint joint="{one.name}" coef="-1"/>
</fixed>""" for one in joints)
    motors = '\n'.join(f"""
<position joint="{one.name}_motor" kp="{servo.stiffness}" kv="{servo.damping}"
          forcerange="{-servo.torque_limit} {servo.torque_limit}"/>""" for one in joints)
    return f"""
<mujoco>
  <option timestep="{STEP_S}" integrator="implicitfast"><flag contact="disable"/></option>
  <compiler boundmass="0" boundinertia="0"/>
  <worldbody>
    <light pos=".3 -1 1" dir="-.3 1 -1"/>
    <geom type="cylinder" size=".05 .03" pos="0 0 .03" rgba=".3 .3 .35 1"/>
    {link}
  </worldbody>
  <tendon>{gaps}</tendon>
  <actuator>{motors}</actuator>
</mujoco>"""


def _text(point: tuple[float, float, float]) -> str:
    return ' '.join(map(str, point))
