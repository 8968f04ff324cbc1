"""A motor with its position loop, a gear with play and a load, as MuJoCo integrates them; no ROS.

                 stiffness, damping           gap, contact
    command v ──[ torque limit ]──► motor ──[ stiffness, damping ]──► load: friction, inertia, arm
                                      └ motor encoder                  └ load encoder

v and both encoders are in the unit of the load, rad or what `scale` makes of rad or m: the ratio of
the gear is taken out, and motor inertia and stiffness are as they appear behind it. SI units else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from math import pi

import mujoco

STEP_S = 0.25e-3  # of the integration
# Share of the contact that MuJoCo adds as an inertia of its own: it has to be small, not 0.
SOFTNESS = 1e-3
STICK = 0.9999  # how well dry friction holds: less of it, and a load that should stick creeps
ARCMIN, DEGREE = pi / 10800.0, pi / 180.0


@dataclass(frozen=True)
class Gear:
    """Constants of one actuator. Angles in rad, forces in Nm; with linear=True m and N.

    stiffness, damping: of the position loop of the motor. contact_*: of the gear once the gap is
    closed. friction: dry friction of the load, viscous: per speed. arm_*: a mass that hangs on the
    load. *_resolution: steps of the encoders, 0 for none. reach, rate: how far and how fast v may
    go either way. swing, frequency: of an ordinary motion [Hz]. source: of the figures.
    """

    about: str
    gap: float
    contact_stiffness: float
    contact_damping: float
    motor_inertia: float
    stiffness: float
    damping: float
    torque_limit: float
    load_inertia: float
    friction: float
    viscous: float
    motor_resolution: float
    load_resolution: float
    reach: float
    rate: float
    swing: float
    frequency: float
    sample_period: float
    source: str
    arm_mass: float = 0.0
    arm_length: float = 0.0
    linear: bool = False
    scale: float = 1.0

    @property
    def total_inertia(self) -> float:
        """Of the load with its arm."""
        return self.load_inertia + self.arm_mass * self.arm_length**2

    @property
    def lost_motion(self) -> float:
        """Gap and wind-up of gear and position loop by dry friction, in the unit of v."""
        windup = 2.0 * self.friction * (1.0 / self.stiffness + 1.0 / self.contact_stiffness)
        return self.scale * (self.gap + windup)

    def with_settings(self, settings: list[str]) -> Gear:
        """The same with KEY=VALUE changed. Raises ValueError: no such key, or not its type."""
        names = [one.name for one in fields(self) if isinstance(getattr(self, one.name), float)]
        changes = {}
        for setting in settings:
            key, _, text = setting.partition('=')
            try:
                changes[key] = float(text)
            except ValueError:
                key = ''
            if key not in names:
                raise ValueError(
                    f'{setting!r} must be KEY=NUMBER, KEY one of {", ".join(names)}'
                )
        return replace(self, **changes)


PRESETS = {
    'servo': Gear(
        'hobby servo joint, 12 bits', gap=0.6 * DEGREE,
        # 1.3 degrees of play under the rated torque of 1 Nm either way.
        contact_stiffness=2.0 * 1.0 / (0.7 * DEGREE), contact_damping=0.15,
        motor_inertia=0.01, stiffness=27.0, damping=1.0, torque_limit=2.9,
        load_inertia=0.001, arm_mass=0.0, arm_length=0.15, friction=0.05, viscous=0.005,
        motor_resolution=2.0 * pi / 2**12, load_resolution=2.0 * pi / 2**12,
        reach=0.6, rate=1.5, swing=0.2, frequency=0.5, sample_period=0.005,
        source='Feetech STS3215: 12 bits, play 0.5 degrees at most as specified and about 1 as '
               'measured by hand, 30 kg cm, 1.8 to 2.6 degrees of error at 1 Nm '
               '(https://github.com/TheRobotStudio/SO-ARM100/issues/134)',
    ),
    'robot': Gear(
        'robot joint with a planetary gear 100:1', gap=8.0 * ARCMIN,
        contact_stiffness=12.0 / ARCMIN, contact_damping=30.0,
        motor_inertia=1.0, stiffness=9000.0, damping=150.0, torque_limit=150.0,
        load_inertia=0.5, friction=5.0, viscous=0.5,
        motor_resolution=2.0 * pi / 2**17 / 100.0, load_resolution=2.0 * pi / 2**17,
        reach=0.06, rate=0.12, swing=0.02, frequency=0.5, sample_period=0.005,
        source='8 arcmin and 12 Nm/arcmin of a standard planetary gear for robot joints '
               '(https://gearboxplanetary.com/application/'
               'inline-planetary-gearbox-in-industrial-robot-joint-servo-reducer-applications/)',
    ),
    'cnc': Gear(
        'axis of a CNC machine [mm]', gap=0.03e-3,
        contact_stiffness=5e7, contact_damping=2e4,
        motor_inertia=118.0, stiffness=7.5e6, damping=4e4, torque_limit=2000.0,
        load_inertia=30.0, friction=40.0, viscous=100.0,
        motor_resolution=0.5e-6, load_resolution=0.5e-6,
        reach=1.5e-3, rate=5e-3, swing=0.4e-3, frequency=0.5, sample_period=0.005,
        linear=True, scale=1e3,
        source='0.015 mm measured with a dial indicator on ball screws of 5 and 10 mm '
               '(https://scottstuff.net/posts/2019/05/21/measuring-backlash-part-2/), 0.11 mm on '
               'another machine (https://forum.snapmaker.com/t/13219/21)',
    ),
    'valve': Gear(
        'quarter-turn valve or damper with much friction', gap=0.9 * DEGREE,
        contact_stiffness=5000.0, contact_damping=20.0,
        motor_inertia=5.0, stiffness=8000.0, damping=300.0, torque_limit=150.0,
        load_inertia=0.05, friction=20.0, viscous=1.0,
        motor_resolution=2.0 * pi / 2**14, load_resolution=2.0 * pi / 2**14,
        reach=0.6, rate=0.6, swing=0.25, frequency=0.2, sample_period=0.01,
        source='dead band of 1 % of the travel, EnTech Control Valve Dynamic Specification 3.0 '
               '(https://manuzoid.com/manuals/46aRo-Emerson%20Control%20Valve%20Dynamic%20'
               'User%20guide)',
    ),
    'telescope': Gear(
        'axis of a telescope with little friction and much inertia', gap=2.0 * ARCMIN,
        contact_stiffness=2e4, contact_damping=80.0,
        motor_inertia=20.0, stiffness=8e4, damping=1800.0, torque_limit=400.0,
        load_inertia=8.0, friction=0.2, viscous=0.2,
        motor_resolution=2.0 * pi / 2**22, load_resolution=2.0 * pi / 2**20,
        reach=0.006, rate=0.01, swing=0.003, frequency=0.3, sample_period=0.01,
        source='about 2 arcmin of a worm gear (https://www.celestron.com/blogs/knowledgebase/'
               'i-m-experiencing-motion-in-ra-east-after-slews-with-my-celestron-german-goto-mount-'
               'is-this-backlash-and-how-do-i-correct-it)',
    ),
}


class GearPhysics:
    """The actuator in motion, beginning at rest in the middle of the gap."""

    def __init__(self, gear: Gear) -> None:
        self.gear = gear
        self.model = mujoco.MjModel.from_xml_string(_description(gear))
        set_contact(self.model, gear.contact_stiffness, gear.contact_damping)
        self.data = mujoco.MjData(self.model)

    def move_to(self, v: float) -> None:
        """Command the motor."""
        self.data.ctrl[0] = v / self.gear.scale

    def advance(self, seconds: float) -> None:
        """Integrate, a whole number of STEP_S."""
        mujoco.mj_step(self.model, self.data, round(seconds / STEP_S))

    @property
    def motor(self) -> float:
        """Position of the motor as it is."""
        return self.gear.scale * float(self.data.qpos[0])

    @property
    def load(self) -> float:
        """Position of the load as it is."""
        return self.gear.scale * float(self.data.qpos[1])

    def motor_encoder(self) -> float:
        """Position of the motor as it is measured."""
        return rounded(self.motor, self.gear.scale * self.gear.motor_resolution)

    def load_encoder(self) -> float:
        """Position of the load as it is measured."""
        return rounded(self.load, self.gear.scale * self.gear.load_resolution)


def set_contact(model: mujoco.MjModel, stiffness: float, damping: float) -> None:
    """Make the limits of all tendons springs with dampers that push and never pull.

    MuJoCo solves f = max(0, (-b x' - k x - x'') / R), R = (1 - d) / d W, x the way into the
    limit, W the inverse inertia that it sees (Computation, Constraint model). With k = K R and
    b = B R that is f = K x + B x' and, with d small, next to no inertia. Negative solref are
    -k d and -b d.
    """
    r = (1.0 - SOFTNESS) * model.tendon_invweight0
    model.tendon_solref_lim[:, 0] = -stiffness * r
    model.tendon_solref_lim[:, 1] = -damping * r
    model.tendon_solimp_lim[:, :2] = SOFTNESS


def rounded(value: float, step: float) -> float:
    """Return the nearest multiple of step, the value itself where step is 0."""
    return step * round(value / step) if step else value


def _description(gear: Gear) -> str:
    """The model in the language of MuJoCo; sizes of what is drawn mean nothing."""
    kind, axis = ('slide', '1 0 0') if gear.linear else ('hinge', '0 1 0')
    half = 0.5 * gear.gap
    return f"""
<mujoco>
  <option timestep="{STEP_S}" integrator="implicitfast" tolerance="1e-14">
    <flag contact="disable"/>
  </option>
  <compiler boundmass="0" boundinertia="0"/>
  <worldbody>
    <light pos="0 -1 1" dir="0 1 -1"/>
    <body name="motor" pos="0 0.06 0">
      <joint name="motor" type="{kind}" axis="{axis}"/>
      {_inertial(gear.motor_inertia)}
      <geom type="cylinder" size="0.03 0.02" euler="90 0 0" rgba=".3 .3 .35 1"/>
      <geom type="box" size="0.004 0.021 0.02" pos="0 0 0.03" rgba=".9 .5 .1 1"/>
    </body>
    <body name="load">
      <joint name="load" type="{kind}" axis="{axis}" damping="{gear.viscous}"
             frictionloss="{gear.friction}" solreffriction="{2.0 * STEP_S} 1"
             solimpfriction="{STICK} {STICK} 1 0.5 2"/>
      {_inertial(gear.load_inertia)}
      <geom type="cylinder" size="0.05 0.02" euler="90 0 0" rgba=".6 .65 .7 1"/>
      <geom type="box" size="0.005 0.021 0.08" pos="0 0 0.06" rgba=".1 .4 .8 1"/>
      <body pos="0 0 {-gear.arm_length}">
        {_inertial(0.0, gear.arm_mass)}
        <geom type="sphere" size="0.012" rgba=".2 .2 .2 1"/>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="gap" limited="true" range="{-half} {half}">
      <joint joint="motor" coef="1"/>
      <joint joint="load" coef="-1"/>
    </fixed>
  </tendon>
  <actuator>
    <position joint="motor" kp="{gear.stiffness}" kv="{gear.damping}"
              forcerange="{-gear.torque_limit} {gear.torque_limit}"/>
  </actuator>
</mujoco>"""


def _inertial(inertia: float, mass: float | None = None) -> str:
    """Both as mass and as inertia about the axis, of which the joint takes one."""
    least = 1e-12  # MuJoCo has no body without
    mass = inertia if mass is None else mass
    about = max(inertia, least)
    return f'<inertial pos="0 0 0" mass="{max(mass, least)}" ' \
           f'diaginertia="{about} {about} {about}"/>'
