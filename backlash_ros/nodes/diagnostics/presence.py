"""Who of this machine may come to command a topic, known at once and without the middleware.

Discovery takes as long as it takes: a tenth of a second, or several where a message of it is lost
or a processor is busy. Every controller therefore holds a Unix socket in the abstract namespace of
Linux, whose name tells the domain, the topic and the identity of its publisher. The kernel lists
these names, and takes a name back with its process, however that ends. Processes in containers
see each other if they share the network; other systems than Linux list nobody.
"""

from __future__ import annotations

import hashlib
import socket
import sys
from contextlib import suppress
from pathlib import Path

LISTED = Path('/proc/net/unix')


class Presence:
    """Makes a publisher of a topic known to all of this machine until it is closed.

    domain: ROS_DOMAIN_ID. topic: its full name. identity: of the publisher, in letters and digits.
    """

    def __init__(self, domain: int, topic: str, identity: str) -> None:
        # A name may have 107 bytes, a topic more.
        place = hashlib.sha256(f'{domain} {topic}'.encode()).hexdigest()[:32]
        self._prefix, self._own = f'@backlash_ros/{place}/', identity
        self._socket: socket.socket | None = None
        if sys.platform == 'linux':
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            # Nobody else can have this identity; where sockets are forbidden, nobody is listed.
            with suppress(OSError):
                self._socket.bind(f'\0{self._prefix[1:]}{identity}')

    def others(self) -> frozenset[str]:
        """Identities of the other publishers."""
        try:
            names = [line.rsplit(' ', 1)[-1] for line in LISTED.read_text().splitlines()]
        except OSError:
            return frozenset()
        found = {
            name.removeprefix(self._prefix) for name in names if name.startswith(self._prefix)
        }
        return frozenset(found - {self._own})

    def close(self) -> None:
        """Let go of the name."""
        if self._socket is not None:
            self._socket.close()
