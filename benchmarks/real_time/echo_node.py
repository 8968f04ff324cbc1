"""The barest node that answers: it publishes every number it gets. A yardstick for latency."""

import contextlib

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import Float64


def main() -> None:
    """Answer on echo/out what comes on echo/in until stopped."""
    rclpy.init()
    node = rclpy.create_node('echo')
    out = node.create_publisher(Float64, 'echo/out', 1)
    node.create_subscription(Float64, 'echo/in', out.publish, 1)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
