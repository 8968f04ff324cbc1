"""Command-line tools: they start nodes as processes, simulate, analyse and draw."""

import os
import signal
import sys
from types import FrameType

from backlash_ros.options import FAILED, use_one_thread


def leave(_: int, frame: FrameType | None) -> None:
    """End the process while it imports, where run_tool does not yet report an interrupt."""
    os.write(2, b'interrupted\n')
    os._exit(FAILED)


# With -m, sys.argv[0] is '-m' until the module is found; else it is the installed script. Where
# SIGINT is ignored, as in the background of a script, it stays so.
if sys.argv and os.path.basename(sys.argv[0]) in (
    '-m', 'bringup', 'simulate', 'report', 'compare', 'identify', 'replay',
) and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, leave)

use_one_thread()
