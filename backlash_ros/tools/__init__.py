"""Command-line tools: they start nodes as processes, simulate, analyse and draw."""

import os
import signal
from types import FrameType

from backlash_ros import starts_one_of
from backlash_ros.options import FAILED, use_one_thread


def leave(_: int, frame: FrameType | None) -> None:
    """End the process while it imports, where run_tool does not yet report an interrupt."""
    os.write(2, b'interrupted\n')
    os._exit(FAILED)


# Where SIGINT is ignored, as in the background of a script, it stays so.
if signal.getsignal(signal.SIGINT) is signal.default_int_handler and starts_one_of(
    'bringup', 'simulate', 'report', 'compare', 'identify', 'replay',
):
    signal.signal(signal.SIGINT, leave)

use_one_thread()
