"""Driver of a motor, a gear with play and a load that MuJoCo integrates (pip install mujoco).

    python examples/mujoco_gear.py --preset robot --limits > limits.yaml
    python examples/mujoco_gear.py --preset robot

in one terminal, then in another, as with any driver:

    identify --drive --config limits.yaml --out identified
    bringup --config identified/identified.yaml --driver none --duration 20

It is motor_driver.py with another motor, in real time: each reading of the load moves the gear on
by one sample, or by as many as have passed. docs/physics.md tells what to expect of the presets.
"""

from __future__ import annotations

import argparse
import sys
import time
from math import inf

import motor_driver
import mujoco.viewer
from gear_physics import PRESETS, Gear, GearPhysics

ON_TIME = 0.25  # of a period: a reading that is later than a period less this has missed one


class GearMotor(GearPhysics):
    """The gear with the functions that motor_driver.py asks a motor for."""

    def __init__(self, gear: Gear, view: bool) -> None:
        super().__init__(gear)
        self._due = inf  # when the next reading is [s]
        self._viewer = mujoco.viewer.launch_passive(self.model, self.data) if view else None

    def load_encoder(self) -> float:
        """Go on by one sample, and by those that the machine was too busy for; read the load."""
        now, period = time.monotonic(), self.gear.sample_period
        missed = int(max((now - self._due) / period + ON_TIME, 0.0))
        self.advance((1 + missed) * period)
        self._due = min(self._due + missed * period, now) + period
        if self._viewer is not None and self._viewer.is_running():
            self._viewer.sync()
        return super().load_encoder()

    def command(self) -> float:
        """Return the v that acts: late commands and those of the watchdog are no riddle then."""
        return self.gear.scale * float(self.data.ctrl[0])


def limits(gear: Gear) -> str:
    """All that `identify --drive` has to be told."""
    reach, rate = gear.scale * gear.reach, gear.scale * gear.rate
    return f"""# {gear.about}
/**:
  ros__parameters:
    sample_period: {gear.sample_period:g}
    control: {{min: {-reach:.6g}, max: {reach:.6g}, rate_max: {rate:.6g}}}"""


def described(names: dict[str, Gear]) -> str:
    """A line for each preset."""
    return '\n'.join(
        f'  {name:10} {gear.about}; gap {gear.scale * gear.gap:.4g}, with wind-up '
        f'{gear.lost_motion:.4g}. {gear.source}' for name, gear in names.items()
    )


def main() -> int:
    """Run until SIGINT or SIGTERM."""
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=f'presets:\n{described(PRESETS)}',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--preset', choices=PRESETS, default='servo')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE',
                        help='change a constant of the preset, in SI units (see gear_physics.py)')
    parser.add_argument('--view', action='store_true', help='show it; needs a display')
    parser.add_argument('--report', action='store_true',
                        help='tell the motor encoder on applied_control, not the command that acts')
    parser.add_argument('--limits', action='store_true',
                        help='print sample period and limits as a parameter file, and end')
    options = parser.parse_args()
    try:
        gear = PRESETS[options.preset].with_settings(options.set)
    except ValueError as error:
        parser.error(str(error))
    if options.limits:
        print(limits(gear))
        return 0
    motor_driver.motor = motor = GearMotor(gear, options.view)
    motor_driver.SAMPLE_PERIOD_S = gear.sample_period
    motor_driver.V_MAX = gear.scale * gear.reach
    motor_driver.V_MIN = -motor_driver.V_MAX
    if not options.report:
        motor_driver.read_motor_position = motor.command
    motor_driver.main()
    return 0


if __name__ == '__main__':
    sys.exit(main())
