"""Driver of a position-controlled motor: change the four functions at the top, keep the rest.

Watchdog: where no v has come for 20 sample periods, the motor is stopped until the next one comes,
whatever the controller promises. As it is, the file moves a tiny simulated motor with a load behind
a worn gear, the one that config/geared_motor.yaml describes. docs/driver.md explains it.
"""

import math
import signal
from threading import Event

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from simulated_motor import SimulatedMotor
from std_msgs.msg import Float64

SAMPLE_PERIOD_S = 0.005  # sample_period of the controller
V_MIN, V_MAX = -12.6, 12.6  # [rad]; whatever the controller says, the motor stays within
WATCHDOG_SAMPLES = 20  # without a v, after which the motor is stopped

motor = SimulatedMotor(SAMPLE_PERIOD_S)


# ---- HARDWARE: write v to your motor --------------------------------------------------------
def write_motor_position(v: float) -> None:
    """Command the motor to v [rad]."""
    motor.move_to(v)


# ---- HARDWARE: stop your motor --------------------------------------------------------------
def stop_motor() -> None:
    """Hold the present position; where v is a speed or a torque, command 0 instead."""
    motor.move_to(motor.motor_encoder())


# ---- HARDWARE: read v before the gap --------------------------------------------------------
def read_motor_position() -> float:
    """Return the v that the motor has really taken [rad]; nan while it is not known."""
    return motor.motor_encoder()


# ---- HARDWARE: read y behind the gap --------------------------------------------------------
def read_load_position() -> float:
    """Return the angle of the load [rad]."""
    return motor.load_encoder()


# ---- the driver -----------------------------------------------------------------------------
class MotorDriver(Node):
    """Publishes y(k) once per sample period, and applies v(k) as soon as it comes."""

    def __init__(self) -> None:
        super().__init__('motor_driver')
        self.unheard = WATCHDOG_SAMPLES  # samples since the newest v; there is none to stop yet
        self.report = self.create_publisher(Float64, 'applied_control', 10)
        self.output = self.create_publisher(Float64, 'plant_output', 10)
        self.create_subscription(Float64, 'control', self.on_control, 1)
        self.create_timer(SAMPLE_PERIOD_S, self.on_sample)

    def on_control(self, message: Float64) -> None:
        """Apply v, within the limits."""
        if math.isfinite(message.data):
            self.unheard = 0
            write_motor_position(min(max(message.data, V_MIN), V_MAX))

    def on_sample(self) -> None:
        """Publish y, after the v that led to it; look whether v still comes."""
        y, applied = read_load_position(), read_motor_position()
        if math.isfinite(applied):
            self.report.publish(Float64(data=applied))
        if math.isfinite(y):
            self.output.publish(Float64(data=y))
        self.unheard += 1
        if self.unheard == WATCHDOG_SAMPLES:
            self.get_logger().warning('no control: the motor is stopped')
            stop_motor()


def main() -> None:
    """Run until SIGINT or SIGTERM."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    stopping = Event()  # an exception could be raised in the middle of reading a message
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopping.set())
    node = MotorDriver()
    while not stopping.is_set():
        rclpy.spin_once(node, timeout_sec=0.1)
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
