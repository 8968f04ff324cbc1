"""Find other publishers of the command, and decide which of them has to stand down."""

import errno
import hashlib
import socket
import time
from collections.abc import Callable, Mapping
from math import inf
from typing import NamedTuple

from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.executor import serve_polled
from backlash_ros.nodes.runtime.messages import SILENT_S, arrival_ns, name_of
from backlash_ros.nodes.runtime.process import ProcessNode

# Keys in /diagnostics by which controllers know each other.
ENDPOINT, SINCE = 'endpoint of control', 'active since [ns]'
WAITS_NS = 2**63 - 1  # instead of that time: waits for the lock, behind all others


class CommandLock:
    """Lets only one process of a machine command a topic, even before they discover each other.

    The lock is a name in the abstract namespace of Unix sockets (Linux), made of domain and topic.
    The kernel releases it when its process ends, however that ends.
    """

    def __init__(self, domain: int, topic: str) -> None:
        # A name may have 107 bytes, and a topic may be longer.
        place = hashlib.sha256(f'{domain} {topic}'.encode()).hexdigest()
        self._name = f'\0backlash_ros/{place}'
        self._socket: socket.socket | None = None

    def take(self) -> bool:
        """Take the lock if it is free; returns whether this process has it."""
        if self._socket is None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._socket.bind(self._name)
            except OSError as error:
                # If sockets are forbidden, every process has it.
                if error.errno == errno.EADDRINUSE:
                    self.release()
        return self._socket is not None

    def release(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class Rival(NamedTuple):
    """Another publisher of the command, and whether it was active before this controller."""

    name: str
    was_first: bool


class Rivals:
    """Tells which of several publishers was first, by their times and identities in /diagnostics.

    A publisher without such entries was first if it was there when this controller became active.
    A controller that is inactive or silent is no rival. since_ns: since when this one is active, 0
    if it is not. settled_at: when discovery knows all that were there before, steady clock [s].
    """

    def __init__(self, own: str, settled_at: float) -> None:
        self.own, self.settled_at = own, settled_at
        self.since_ns, self._active_at = 0, 0.0
        # By identity: since when it is active [ns], 0 if it is not, and when it said so; or None
        # and when it was found, if it says nothing.
        self._known: dict[str, tuple[int | None, float]] = {}

    def begin(self, since_ns: int, now: float) -> None:
        self.since_ns, self._active_at = since_ns, now

    def hear(self, values: Mapping[str, str], now: float) -> None:
        identity, since = values.get(ENDPOINT, ''), values.get(SINCE, '')
        if identity and since.isdecimal():
            self._known[identity] = int(since), now

    def among(self, others: Mapping[str, str], now: float) -> tuple[Rival, ...]:
        """The rivals among the other publishers, which are given as names by identity."""
        self._known = {each: self._known.get(each, (None, now)) for each in others}
        found = []
        for each, name in others.items() if self.since_ns else ():
            since_ns, at = self._known[each]
            if since_ns is None:
                found.append(Rival(name, at <= max(self._active_at, self.settled_at)))
            elif since_ns > 0 and now < at + SILENT_S:
                found.append(Rival(name, (since_ns, each) < (self.since_ns, self.own)))
        return tuple(sorted(found))


class RivalWatch(Rivals):
    """Watches for other publishers of the command while the node runs.

    On each machine only the controller with the lock competes with those of other machines.
    changed: called when there is news to publish. found: the rivals at the last look.
    """

    def __init__(self, node: ProcessNode, io: DriverIo, changed: Callable[[], None]) -> None:
        self.topic = node.resolve_topic_name(io.topics.control)
        self._node, self._changed = node, changed
        # Discovery rarely takes longer: a publisher that is found by then was there before.
        super().__init__(self._identity_after(io.advertise), time.monotonic() + 0.7)
        self.found: tuple[Rival, ...] = ()
        self._lock = CommandLock(node.context.get_domain_id(), self.topic)
        self._told: tuple[tuple[Rival, ...], bool] = (), False  # at the last look
        self._hello_until = -inf  # until then, others are told at every look who was first
        self._diagnostics = node.listen_to_diagnostics(
            lambda _, values, received_ns: self.hear(values, 1e-9 * arrival_ns(received_ns))
        )
        node.every(0.2, self.look)

    @property
    def any_first(self) -> bool:
        """Whether another publisher is in charge of the actuator."""
        return self.since_ns == WAITS_NS or any(rival.was_first for rival in self.found)

    @property
    def claim(self) -> dict[str, object]:
        return {ENDPOINT: self.own, SINCE: self.since_ns}

    def follow(self, active: bool) -> None:
        """Compete for the actuator while the controller is active."""
        if not active:
            self._lock.release()
        self.begin(WAITS_NS if active else 0, time.monotonic())
        self.look()

    def look(self) -> None:
        now, node = time.monotonic(), self._node
        if self.since_ns == WAITS_NS and self._lock.take():
            self.begin(time.time_ns(), now)
        # To count publishers is ten times cheaper than to ask for their names.
        infos = node.get_publishers_info_by_topic(self.topic) \
            if node.count_publishers(self.topic) > 1 else []
        others = {identity_of(info): name_of(info) for info in infos}
        others.pop(self.own, None)
        if others.keys() != self._known.keys():
            self._hello_until = now + 2.0
        if others:
            serve_polled(self._diagnostics)
        self.found = self.among(others, now)
        before, self._told = self._told, (self.found, self.any_first)
        if before[0] and not self.found:
            node.log.info(f'nobody else publishes {self.topic} any more')
        if self._told != before or (others and now < self._hello_until):
            self._changed()

    def _identity_after(self, advertise: Callable[[], object]) -> str:
        """The identity of the publisher that `advertise` makes, which rclpy does not tell."""
        node, own_name = self._node, self._node.get_fully_qualified_name()
        before = {identity_of(info) for info in node.get_publishers_info_by_topic(self.topic)}
        advertise()
        for _ in range(10_000):
            # A namesake that is discovered at this moment has no name yet.
            for info in node.get_publishers_info_by_topic(self.topic):
                if identity_of(info) not in before and name_of(info) == own_name:
                    return identity_of(info)
            time.sleep(1e-3)
        raise RuntimeError(f'the graph does not show the own publisher of {self.topic}')


def identity_of(info: TopicEndpointInfo) -> str:
    """Identity of an endpoint, the same in every process."""
    return bytes(info.endpoint_gid).hex()
