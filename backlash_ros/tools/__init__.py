"""Command-line tools: they start nodes as processes, simulate, analyse and draw."""

from backlash_ros.options import use_one_thread

use_one_thread()
