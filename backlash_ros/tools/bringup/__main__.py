"""One command for a whole run: start the nodes, watch them, stop them, report.

driver: with --driver COMMAND that command runs instead of the simulated plant; {axis} in it is
replaced by the name of the axis, and axes with the same command share one driver. --driver none
waits for a driver that you start yourself. As a driver moves something real, control.min,
control.max and control.rate_max have to be set, or --unlimited given.

axes: the parameter axes, in the section /bringup of the file, lists names; each gets nodes of its
own in the namespace of that name and a folder DIR/NAME. If one axis fails, all are stopped.

joints: a file with the parameter joints is for one controller of all joints, with its recorder. It
needs --driver; y_m comes from a motion planner. Each joint gets a report in DIR/JOINT.

exit codes: 0 done, 2 bad input, 1 anything else (a process died, nothing moves, interrupted).
A first Ctrl-C (SIGTERM, SIGHUP) stops all processes in order and reports what was recorded, a
second one kills them at once. It is the regular end of a run with --duration inf.

environment: unless you set them yourself, ROS_AUTOMATIC_DISCOVERY_RANGE is LOCALHOST, ROS_LOG_DIR
is DIR/logs/ros, and ROS_DOMAIN_ID is one that nobody uses on this machine (0 with --driver none),
which is printed, so that you can listen in.
"""

import argparse
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial

from backlash_ros.options import DONE, FAILED, OptionParser, port
from backlash_ros.tools import cli


def parse_options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = OptionParser('bringup', description=__doc__,
                          formatter_class=argparse.RawDescriptionHelpFormatter)
    cli.add_options(parser, '--config', '--set', '--axis', '--seed', '--out', '--duration')
    parser.add_argument('--driver', metavar='COMMAND', help='start this command instead of the '
                        'simulated plant; none: it is started elsewhere')
    parser.add_argument('--unlimited', action='store_true', help='let a driver run without '
                        'control.min, control.max and control.rate_max')
    parser.add_argument('--lockstep', action='store_true', help='as fast as the machine allows, '
                        'every sample waiting for its control, instead of real time')
    parser.add_argument('--record', action=argparse.BooleanOptionalAction, default=True,
                        help='record a bag and write a report from it')
    parser.add_argument('--live', action='store_true',
                        help='show the loop on a page in the browser; its address is printed')
    parser.add_argument('--live-port', type=port, metavar='PORT', help='the same on this port')
    return parser.parse_args(arguments)


def _end(*_: object) -> None:
    os.write(2, b'bringup: interrupted\n')
    os._exit(FAILED)


def _bringup(arguments: Sequence[str] | None) -> int:
    options = parse_options(arguments)
    # numpy and scipy take a second to load, and may swallow a KeyboardInterrupt.
    before = signal.signal(signal.SIGINT, _end)
    from backlash_ros.tools.bringup.plan import prepare
    from backlash_ros.tools.bringup.watch import report, run
    signal.signal(signal.SIGINT, before)
    axes = prepare(options)
    live_port = 0 if options.live and options.live_port is None else options.live_port
    failure = run(axes, options.record, live_port)
    reported = [axis.made > 0 and report(axis, options.record) for axis in axes]
    return DONE if all(reported) and not failure else FAILED


main = partial(cli.run_tool, 'bringup', _bringup)

if __name__ == '__main__':
    sys.exit(main())
