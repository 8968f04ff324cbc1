"""Sleeps until each next period, like a plant that has nothing to do; a yardstick for pauses.

    python benchmarks/real_time/bare_clock.py PERIOD_S

At the end, SIGINT, it tells how many periods it was too late for: the machine did not run it.
"""

from __future__ import annotations

import signal
import sys
import time

from backlash_ros.nodes.plant import LATEST_SHARE


def main() -> None:
    """Count until interrupted."""
    # A shell ignores it for what it runs in the background.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    period_s = float(sys.argv[1])
    due = time.monotonic()
    ticks = missed = 0
    longest = 0.0
    try:
        while True:
            ticks, due = ticks + 1, due + period_s
            time.sleep(max(due - time.monotonic(), 0.0))
            late = time.monotonic() - due
            longest = max(longest, late)
            missed += late > LATEST_SHARE * period_s
    except KeyboardInterrupt:
        print(f'{ticks} periods, {missed} missed, the latest by {1e3 * longest:.1f} ms',
              file=sys.stderr)


if __name__ == '__main__':
    main()
