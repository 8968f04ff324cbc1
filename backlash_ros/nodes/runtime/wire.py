"""Messages as they go over the wire, for those that come and leave with every sample.

rclpy takes and publishes these bytes as they are, in half the time of a std_msgs/Float64, and in a
tenth of that of a sensor_msgs/JointState of six joints. Four bytes name the encoding, the second
one odd where the lowest byte comes first. What follows is aligned to its size (CDR: DDS
Interoperability Wire Protocol, 10.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from struct import Struct, pack, unpack_from
from typing import NamedTuple

CDR_FLOAT64 = Struct('<xBxxd')


def number_of(message: bytes) -> float:
    """What a std_msgs/Float64 holds."""
    number: float = (CDR_FLOAT64 if message[1] & 1 else Struct('>xBxxd')).unpack_from(message)[1]
    return number


def message_with(number: float) -> bytes:
    """A std_msgs/Float64."""
    return CDR_FLOAT64.pack(1, number)


class JointMessage(NamedTuple):
    """What a sensor_msgs/JointState holds but for its frame; stamp_ns: of its header."""

    stamp_ns: int = 0
    name: tuple[str, ...] = ()
    position: Sequence[float] = ()
    velocity: Sequence[float] = ()
    effort: Sequence[float] = ()


class JointReader:
    """Reads messages that mostly are about the same joints."""

    def __init__(self) -> None:
        self._head = b''  # of the newest message, from its frame to its names
        self._name: tuple[str, ...] = ()

    def read(self, message: bytes) -> JointMessage:
        """What a sensor_msgs/JointState holds."""
        order = '<' if message[1] & 1 else '>'
        seconds, nanoseconds = unpack_from(order + 'iI', message, 4)
        at = 12 + len(self._head)
        if not self._head or message[12:at] != self._head:
            at = self._read_names(message, order)
        fields = []
        for _ in range(3):
            at += -at % 4
            count, = unpack_from(order + 'I', message, at)
            at += 4
            if count:
                at += (4 - at) % 8  # the encoding before does not count
            fields.append(unpack_from(f'{order}{count}d', message, at))
            at += 8 * count
        return JointMessage(seconds * 10**9 + nanoseconds, self._name, *fields)

    def _read_names(self, message: bytes, order: str) -> int:
        """Read the frame and all names; returns where they end."""
        texts, left, at = [], 1, 12
        while left:
            at += -at % 4
            size, = unpack_from(order + 'I', message, at)
            texts.append(message[at + 4:at + 3 + size].decode(errors='replace'))
            at += 4 + size
            left -= 1
            if len(texts) == 1:
                at += -at % 4
                left, = unpack_from(order + 'I', message, at)
                at += 4
        self._head, self._name = message[12:at], tuple(texts[1:])
        return at


def joint_message(content: JointMessage) -> bytes:
    """A sensor_msgs/JointState without a frame."""
    message = bytearray(pack('<xBxxiI', 1, *divmod(content.stamp_ns, 10**9)))
    message += _head_of(content.name)
    for values in content[2:]:
        message += bytes(-len(message) % 4) + len(values).to_bytes(4, 'little')
        if values:
            message += bytes((4 - len(message)) % 8) + pack(f'<{len(values)}d', *values)
    return bytes(message)


@lru_cache(maxsize=8)
def _head_of(names: tuple[str, ...]) -> bytes:
    """An empty frame and the names, as they are in a message."""
    head = bytearray(b'\x01\x00\x00\x00\x00\x00\x00\x00' + len(names).to_bytes(4, 'little'))
    for name in names:
        text = name.encode() + b'\x00'
        head += bytes(-len(head) % 4) + len(text).to_bytes(4, 'little') + text
    return bytes(head)
