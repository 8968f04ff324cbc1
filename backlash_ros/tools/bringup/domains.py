"""ROS domains that nobody uses."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator

from backlash_ros.tools.bringup.processes import RunError

# UDP ports of RTPS: a domain has 250; participant n takes 10 + 2 n and 11 + 2 n of them, and
# domains up to 101 lie below the ports that Linux hands out to others.
DOMAINS = 101
DOMAIN_0_PORT, PORTS_PER_DOMAIN = 7400, 250  # as the standard has them
PARTICIPANT_OFFSETS = range(10, 74, 2)  # as many as the discovery range LOCALHOST looks for
RESERVATION_OFFSET = 5  # port of a domain that a run holds, which no participant takes


@contextlib.contextmanager
def free_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody on this machine uses, reserved as long as the context lasts.

    Every domain has UDP ports of its own (RTPS 2.5, 9.6.2). A domain is in use when the port of
    a participant is taken; a port that no participant ever uses reserves it, and the kernel
    gives that back whatever happens to this process. Raises RunError if all are in use.
    """
    # Starting at the process id spreads runs that start at the same moment.
    for i in range(DOMAINS):
        domain = 1 + (os.getpid() + i) % DOMAINS
        ports = DOMAIN_0_PORT + PORTS_PER_DOMAIN * domain
        with contextlib.ExitStack() as reservation:
            try:
                reservation.enter_context(_bound(ports + RESERVATION_OFFSET))
                for offset in PARTICIPANT_OFFSETS:
                    _bound(ports + offset).close()
            except OSError:
                continue
            yield domain
            return
    raise RunError(f'every ROS_DOMAIN_ID from 1 to {DOMAINS} is in use here: set one yourself')


def _bound(port: int) -> socket.socket:
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        bound.bind(('', port))
    except OSError:
        bound.close()
        raise
    return bound
