"""std_msgs/Float64 as it goes over the wire, so that no message object has to be made of it.

rclpy takes and publishes these bytes as they are, which takes half the time of a Float64. They are
four bytes that name the encoding, the second one odd where the lowest byte comes first, and the
number (CDR: OMG, DDS Interoperability Wire Protocol, 10.2).
"""

from __future__ import annotations

from struct import Struct

LITTLE_ENDIAN = b'\x00\x01\x00\x00'
_LITTLE, _BIG = Struct('<4xd'), Struct('>4xd')
_WHOLE = Struct('<4sd')


def number_of(message: bytes) -> float:
    """The number in a message."""
    number: float = (_LITTLE if message[1] & 1 else _BIG).unpack_from(message)[0]
    return number


def message_with(number: float) -> bytes:
    """A message with this number."""
    return _WHOLE.pack(LITTLE_ENDIAN, number)
