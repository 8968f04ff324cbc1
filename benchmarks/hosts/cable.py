"""A cable between two hosts with delay, jitter and loss, as a process that passes frames on.

`tc netem` does the same inside of the kernel where that has it, which many of clouds and containers
have not. The process makes the two ends as TAP devices in its own network namespace and says that
it is ready; whoever started it moves each end to its host. Frames keep their order, as on a cable.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import os
import random
import select
import struct
import sys
import time
from collections import deque

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000  # linux/if_tun.h
LONGEST_FRAME = 65536
ENDS = ('cable0', 'cable1')
READY = 'ready'


def tap(name: str) -> int:
    """A TAP device of this network namespace, as a file descriptor; raises OSError."""
    device = os.open('/dev/net/tun', os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack('16sH', name.encode(), IFF_TAP | IFF_NO_PI))
    return device


class Lane:
    """One direction of the cable. delay_s, jitter_s: frames take delay ± jitter, uniformly."""

    def __init__(
        self, into: int, out_of: int, delay_s: float, jitter_s: float, loss: float,
        chance: random.Random,
    ) -> None:
        self.into, self._out_of = into, out_of
        self._delay_s, self._jitter_s, self._loss = delay_s, jitter_s, loss
        self._chance = chance
        self._frames: deque[tuple[float, bytes]] = deque()  # with when they come out [s]

    def take(self) -> None:
        """Take in what was sent, and lose a share of it."""
        now = time.monotonic()
        with contextlib.suppress(BlockingIOError):
            while True:
                frame = os.read(self.into, LONGEST_FRAME)
                if self._chance.random() < self._loss:
                    continue
                way_s = self._delay_s + self._chance.uniform(-self._jitter_s, self._jitter_s)
                last = self._frames[-1][0] if self._frames else 0.0
                self._frames.append((max(now + way_s, last), frame))

    def give(self) -> float | None:
        """Let out what is due; return how long until the next frame is [s], None without one."""
        while self._frames:
            wait_s = self._frames[0][0] - time.monotonic()
            if wait_s > 0.0:
                return wait_s
            # An end whose link is down takes nothing.
            with contextlib.suppress(OSError):
                os.write(self._out_of, self._frames[0][1])
            self._frames.popleft()
        return None


def main() -> None:
    """Pass frames on until stdin is closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name in ('delay-ms', 'jitter-ms', 'loss-percent'):
        parser.add_argument(f'--{name}', type=float, default=0.0)
    options = parser.parse_args()
    with contextlib.suppress(PermissionError):  # a cable does not wait for a processor
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(2))
    chance = random.Random(0)
    first, second = map(tap, ENDS)
    lanes = [
        Lane(into, out_of, 1e-3 * options.delay_ms, 1e-3 * options.jitter_ms,
             1e-2 * options.loss_percent, chance)
        for into, out_of in ((first, second), (second, first))
    ]
    print(READY, flush=True)
    wait_s: float | None = None
    while True:
        readable, _, _ = select.select([sys.stdin, first, second], [], [], wait_s)
        if sys.stdin in readable:
            return
        for lane in lanes:
            # An end that is down or not yet in its place has nothing to say.
            with contextlib.suppress(OSError):
                lane.take()
        waits = [wait for lane in lanes if (wait := lane.give()) is not None]
        wait_s = min(waits, default=None)


if __name__ == '__main__':
    main()
