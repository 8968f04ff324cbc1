"""ROS 2 nodes. Importing them takes a while, during which a signal has to end the process, too."""

import os
import signal
import sys

from backlash_ros import starts_one_of
from backlash_ros.middleware import ROS_MISSING, ros_is_missing

if starts_one_of(
    'controller', 'plant', 'reference', 'recorder', 'check_driver', 'monitor', 'live',
):
    for _number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(_number, lambda number, frame: os._exit(0))
    # A parent process may block the signals until here, from where on they end the node cleanly.
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    if ros_is_missing():
        sys.exit(ROS_MISSING)

# Only now: this import takes a while, too.
from backlash_ros.options import use_one_thread

use_one_thread()
