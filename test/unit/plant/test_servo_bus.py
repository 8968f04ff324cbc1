"""The emulated bus: byte for byte what the protocol's description prints, and what its SDK asks."""


import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')
pytest.importorskip('dynamixel_sdk', reason='the bus needs dynamixel-sdk (requirements/dev.txt)')

from arm_physics import ArmPhysics
from servo_bus import (
    GOAL,
    POSITION,
    EmulatedBus,
    packet,
)


class Clock:
    """Time that passes when a test says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def bus(clock: Clock) -> EmulatedBus:
    return EmulatedBus(ArmPhysics(), clock)


@pytest.mark.parametrize(('asked', 'answered'), [
    # Of https://emanual.robotis.com/docs/en/dxl/protocol2/: Ping, Read, Write, Sync Read.
    ('FF FF FD 00 01 03 00 01 19 4E', 'FF FF FD 00 01 07 00 55 00 06 04 26 65 5D'),
    ('FF FF FD 00 01 07 00 02 84 00 04 00 1D 15', 'FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0'),
    ('FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89', 'FF FF FD 00 01 04 00 55 00 A1 0C'),
    ('FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA',
     'FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0'
     'FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE'),
])
def test_the_printed_packets_are_answered_byte_for_byte(bus, monkeypatch, asked, answered):
    monkeypatch.setattr('servo_bus.MODEL', 0x0406)
    monkeypatch.setattr('servo_bus.FIRMWARE', 0x26)
    monkeypatch.setattr(bus, '_measure', lambda: None)
    for servo, position in ((1, 0xA6), (2, 0x81F)):
        bus.servos[servo].put(POSITION, position)
    whole = bytes.fromhex(asked)
    assert bus.answer(whole[:5]) == b''
    assert bus.answer(whole[5:]) == bytes.fromhex(answered)


def test_the_printed_sync_write_sets_both_goals(bus: EmulatedBus) -> None:
    written = 'FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87'
    assert bus.answer(b'\x00\xff\xff' + bytes.fromhex(written)) == b''
    assert [bus.servos[one].get(GOAL) for one in (1, 2)] == [150, 170]


def test_a_header_within_a_packet_is_stuffed_and_a_wrong_byte_noticed(bus: EmulatedBus) -> None:
    asked = packet(1, 3, bytes((GOAL, 0)) + b'\xff\xff\xfd\x00')
    assert b'\xff\xff\xfd\xfd' in asked
    assert bus.answer(asked) == packet(1, 0x55, b'\x04')  # out of range, thus understood
    assert bus.answer(asked[:-1] + bytes((asked[-1] ^ 1,))) == packet(1, 0x55, b'\x03')
