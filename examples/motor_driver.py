"""Driver of a position-controlled motor: change the two functions at the top, keep the rest.

As it is, it moves a tiny simulated motor with a load behind a worn gear, the one that
config/geared_motor.yaml describes. docs/driver.md explains it.
"""

import contextlib
import math
import signal

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from simulated_motor import SimulatedMotor
from std_msgs.msg import Float64

SAMPLE_PERIOD_S = 0.005  # sample_period of the controller
V_MIN, V_MAX = -12.6, 12.6  # [rad]; whatever the controller says, the motor stays within

motor = SimulatedMotor(SAMPLE_PERIOD_S)


# ---- HARDWARE: write v to your motor --------------------------------------------------------
def write_motor_position(v: float) -> float:
    """Command the motor to v [rad]; return the v that it really takes."""
    return motor.move_to(v)


# ---- HARDWARE: read y behind the gap --------------------------------------------------------
def read_load_position() -> float:
    """Return the angle of the load [rad]."""
    return motor.load_encoder()


# ---- the driver -----------------------------------------------------------------------------
class MotorDriver(Node):
    """Publishes y(k) once per sample period, and applies v(k) as soon as it comes."""

    def __init__(self) -> None:
        super().__init__('motor_driver')
        self.applied = 0.0
        self.report = self.create_publisher(Float64, 'applied_control', 10)
        self.output = self.create_publisher(Float64, 'plant_output', 10)
        self.create_subscription(Float64, 'control', self.on_control, 1)
        self.create_timer(SAMPLE_PERIOD_S, self.on_sample)

    def on_control(self, message: Float64) -> None:
        """Apply v, within the limits."""
        if math.isfinite(message.data):
            self.applied = write_motor_position(min(max(message.data, V_MIN), V_MAX))

    def on_sample(self) -> None:
        """Publish y, after the v that led to it."""
        y = read_load_position()
        self.report.publish(Float64(data=self.applied))
        if math.isfinite(y):
            self.output.publish(Float64(data=y))


def main() -> None:
    """Run until SIGINT or SIGTERM."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        rclpy.spin(MotorDriver())
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
