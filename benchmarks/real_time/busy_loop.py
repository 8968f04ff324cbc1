"""Takes a share of one processor until it is interrupted: busy_loop.py SHARE."""

import contextlib
import signal
import sys
import time

PERIOD_S = 0.05


def main() -> None:
    """Be busy for SHARE of every period, in time of the processor, and sleep for the rest."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    share = float(sys.argv[1])
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            begun, until = time.monotonic(), time.process_time() + share * PERIOD_S
            while time.process_time() < until:
                pass
            time.sleep(max(begun + PERIOD_S - time.monotonic(), 0.0))


if __name__ == '__main__':
    main()
