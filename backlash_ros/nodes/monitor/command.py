"""Shows running controllers in a terminal: state, estimates, excitation, latency, what happens.

Without a terminal a line per controller is printed once a second.
"""

from __future__ import annotations

import argparse
import sys

from rclpy.utilities import remove_ros_args

from backlash_ros.nodes.monitor.followed import give_way
from backlash_ros.nodes.monitor.node import EXECUTABLE, MonitorNode
from backlash_ros.nodes.runtime.arguments import ros_arguments
from backlash_ros.nodes.runtime.spin import run
from backlash_ros.options import OptionParser


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if args is None else args
    parser = OptionParser(
        EXECUTABLE, description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='keys: f freezes or goes on learning, c compensates or not, r (twice) resets the '
               'estimates,\n      s saves them, Tab takes the next controller, q ends.',
    )
    parser.add_argument('name', nargs='*', metavar='NAME',
                        help='a controller or a namespace, as /pan (default: all there are)')
    options = parser.parse_args(remove_ros_args(['', *arguments])[1:])
    give_way()
    return run(EXECUTABLE, lambda: MonitorNode(options.name), ros_arguments(arguments))


if __name__ == '__main__':
    sys.exit(main())
