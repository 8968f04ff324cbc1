"""`bringup`: a whole run as processes. Loading it takes a while, in which Ctrl-C ends it too."""

import os
import signal
import sys


def _end(*_: object) -> None:
    os.write(2, b'bringup: interrupted\n')
    os._exit(1)


# With -m, sys.argv[0] is '-m' until the module is found; else it is the installed script.
if sys.argv and (sys.argv[0] == '-m' or os.path.basename(sys.argv[0]) == 'bringup') \
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end)
