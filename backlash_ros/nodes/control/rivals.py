"""Who else commands the same actuator, and which of them has to stand down."""

import hashlib
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo

from backlash_ros import topics
from backlash_ros.core.loop.diagnosis import UNNAMED
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.executor import serve_polled
from backlash_ros.nodes.runtime.messages import SILENT_S, arrival_ns
from backlash_ros.nodes.runtime.process import ProcessNode

# Keys in /diagnostics by which controllers know each other.
ENDPOINT, SINCE = 'endpoint of control', 'active since [ns]'


class Presence:
    """Makes a publisher of a topic known to all of this machine; discovery may take seconds.

    Every controller holds a Unix socket in the abstract namespace of Linux, named after domain,
    topic and the identity of its publisher. The kernel lists these names, and takes a name back
    with its process, however that ends.
    """

    def __init__(self, domain: int, topic: str, identity: str) -> None:
        # A name may have 107 bytes, a topic more.
        place = hashlib.sha256(f'{domain} {topic}'.encode()).hexdigest()[:32]
        self._prefix, self._own = f'@backlash_ros/{place}/', identity
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        # Nobody else can have this identity; where sockets are forbidden, nobody is listed.
        with suppress(OSError):
            self.socket.bind(f'\0{self._prefix[1:]}{identity}')

    def others(self) -> frozenset[str]:
        try:
            listed = Path('/proc/net/unix').read_text().splitlines()
        except OSError:
            return frozenset()
        parts = (line.rpartition(self._prefix) for line in listed)
        return frozenset(identity for _, found, identity in parts if found) - {self._own}


class Rival(NamedTuple):
    """Another publisher of the command, and whether it was active before this controller."""

    name: str
    was_first: bool


class Rivals:
    """Tells who of several publishers was first, by the time and identity in /diagnostics.

    Whoever says nothing of the kind was first if it was there when this controller became active.
    A controller that is not active, or has fallen silent, is no rival. since_ns: 0 while inactive.
    settled_at: when all are found that were there already, on the steady clock [s].
    """

    def __init__(self, own: str, settled_at: float) -> None:
        self.own, self.settled_at = own, settled_at
        self.since_ns, self._active_at = 0, inf
        self._first_seen: dict[str, float] = {}
        # What controllers say: active since [ns], 0 if they are not, and when they have said so.
        self._claims: dict[str, tuple[int, float]] = {}

    def begin(self, since_ns: int, now: float) -> None:
        self.since_ns, self._active_at = since_ns, now if since_ns else inf

    def hear(self, values: Mapping[str, str], now: float) -> None:
        identity, since = values.get(ENDPOINT, ''), values.get(SINCE, '')
        if identity and identity != self.own and since.isdecimal():
            self._claims[identity] = int(since), now

    def among(self, others: Mapping[str, str], now: float) -> tuple[Rival, ...]:
        """The rivals among the other publishers, given by identity with their names."""
        self._first_seen = {each: self._first_seen.get(each, now) for each in others}
        self._claims = {each: c for each, c in self._claims.items() if each in others}
        found = []
        for each, name in others.items() if self.since_ns else ():
            since_ns, heard_at = self._claims.get(each, (0, inf))
            if heard_at == inf:
                was_first = self._first_seen[each] <= max(self._active_at, self.settled_at)
                found.append(Rival(name, was_first))
            elif since_ns > 0 and now < heard_at + SILENT_S:
                found.append(Rival(name, (since_ns, each) < (self.since_ns, self.own)))
        return tuple(sorted(found))


class RivalWatch:
    """Looks out for other publishers of the command while the node runs.

    changed: called when there is something new to say. found: the rivals at the newest look.
    awaited: controllers of this machine that were there at activation and are not found yet.
    """

    def __init__(self, node: ProcessNode, io: DriverIo, changed: Callable[[], None]) -> None:
        self.topic = node.resolve_topic_name(io.topics.control)
        self.found: tuple[Rival, ...] = ()
        self.awaited: frozenset[str] = frozenset()
        self._node, self._changed = node, changed
        own = identity_made_by(node, self.topic, io.advertise)
        # What discovery mostly takes: a publisher that is found so soon after the node was made was
        # there before it.
        self._rivals = Rivals(own, node.begun_at + 0.7)
        self.presence = Presence(node.context.get_domain_id(), self.topic, own)
        self._others: frozenset[str] = frozenset()
        self._hello_until = -inf  # until then others are told at every look who was first
        self._diagnostics = node.listen(
            DiagnosticArray, topics.DIAGNOSTICS, self._hear, 100, polled=True
        )
        node.every(0.2, self.look)

    @property
    def settled(self) -> bool:
        return time.monotonic() >= self._rivals.settled_at

    @property
    def claim(self) -> dict[str, object]:
        return {ENDPOINT: self._rivals.own, SINCE: self._rivals.since_ns}

    def begin(self, active: bool) -> None:
        # Of two that begin at once the one that is listed later waits for the other at least.
        self.awaited = self.presence.others() if active else frozenset()
        self._rivals.begin(time.time_ns() if active else 0, time.monotonic())
        self.look()

    def look(self) -> None:
        now, before, node = time.monotonic(), self.found, self._node
        # Counting is ten times cheaper than asking who they are.
        infos = node.get_publishers_info_by_topic(self.topic) \
            if node.count_publishers(self.topic) > 1 else []
        others = {identity_of(info): name_of(info) for info in infos}
        others.pop(self._rivals.own, None)
        if self.awaited:
            self.awaited = self.awaited & self.presence.others() - others.keys()
            # Whoever has been found while it was waited for was there before.
            self._rivals.settled_at = max(self._rivals.settled_at, now)
        if self._others != others.keys():
            self._others, self._hello_until = frozenset(others), now + 2.0
        if others:
            serve_polled(self._diagnostics)
        self.found = self._rivals.among(others, now)
        if before and not self.found:
            node.log.info(f'nobody else publishes {self.topic} any more')
        if self.found != before or (others and now < self._hello_until):
            self._changed()

    def _hear(self, message: DiagnosticArray, info: dict[str, Any]) -> None:
        for status in message.status:
            values = {each.key: each.value for each in status.values}
            self._rivals.hear(values, 1e-9 * arrival_ns(info['received_timestamp']))


def name_of(info: TopicEndpointInfo) -> str:
    # Names are discovered a little later than topics, and programs without ROS have none.
    if not info.node_name or 'UNKNOWN' in info.node_name:
        return UNNAMED
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'


def identity_of(info: TopicEndpointInfo) -> str:
    """Identity of an endpoint, one and the same for all who see it."""
    return bytes(info.endpoint_gid).hex()


def identity_made_by(node: Node, topic: str, advertise: Callable[[], Publisher]) -> str:
    """Identity of the publisher that advertise makes; rclpy has no way to ask for it."""
    own_name = node.get_fully_qualified_name()
    before = {identity_of(info) for info in node.get_publishers_info_by_topic(topic)}
    advertise()
    for _ in range(10_000):
        # A namesake that is discovered at this very moment has no name yet.
        for info in node.get_publishers_info_by_topic(topic):
            if identity_of(info) not in before and name_of(info) == own_name:
                return identity_of(info)
        time.sleep(1e-3)
    raise RuntimeError(f'the graph does not show the own publisher of {topic}')
