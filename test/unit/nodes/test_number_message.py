"""Numbers as bytes: the same that the middleware makes of a Float64."""

import struct
from math import inf, isnan, nan

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import Float64

from backlash_ros.nodes.runtime.messages import message_with, number_of

NUMBERS = (0.0, -1.5, 1e-300, 12.345678901234567, inf, -inf)


@pytest.mark.parametrize('number', NUMBERS)
def test_a_number_goes_out_and_comes_in_as_a_float64(number: float) -> None:
    assert deserialize_message(message_with(number), Float64).data == number
    assert number_of(serialize_message(Float64(data=number))) == number


def test_what_is_no_number_stays_none() -> None:
    assert isnan(number_of(message_with(nan)))


def test_a_sender_whose_highest_byte_comes_first_is_understood() -> None:
    assert number_of(b'\x00\x00\x00\x00' + struct.pack('>d', -7.25)) == -7.25
