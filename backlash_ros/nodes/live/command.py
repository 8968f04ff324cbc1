"""Shows running controllers on a page in the browser: state, estimates, moving curves.

The page is served to this machine alone, at an address that is printed.
"""

from __future__ import annotations

import argparse
import sys

from rclpy.utilities import remove_ros_args

from backlash_ros.nodes.live.node import EXECUTABLE, LiveNode
from backlash_ros.nodes.live.page_server import bound_socket
from backlash_ros.nodes.monitor.followed import give_way
from backlash_ros.nodes.runtime.arguments import ros_arguments
from backlash_ros.nodes.runtime.spin import run
from backlash_ros.options import LARGEST_PORT, OptionParser


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    arguments = sys.argv[1:] if args is None else args
    parser = OptionParser(
        EXECUTABLE, description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='From elsewhere: ssh -L PORT:127.0.0.1:PORT HOST, then open the same address there.',
    )
    parser.add_argument('name', nargs='*', metavar='NAME',
                        help='a controller or a namespace, as /pan (default: all there are)')
    parser.add_argument('--port', type=int, default=0, metavar='PORT',
                        help='of the page (default: a free one)')
    options = parser.parse_args(remove_ros_args(['', *arguments])[1:])
    if not 0 <= options.port <= LARGEST_PORT:
        parser.error(f'--port={options.port}: must be from 0 (a free one) to {LARGEST_PORT}')
    try:
        bound = bound_socket(options.port)
    except OSError as error:
        parser.error(f'--port={options.port}: {error.strerror}: choose another one, or none')
    give_way()
    with bound:
        return run(
            EXECUTABLE, lambda: LiveNode(options.name, bound), ros_arguments(arguments)
        )


if __name__ == '__main__':
    sys.exit(main())
