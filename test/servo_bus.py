"""A bus with Dynamixel servos on a pseudo-terminal, byte for byte, and an arm of physics behind it.

Packets and instructions are those of Dynamixel Protocol 2.0
(https://emanual.robotis.com/docs/en/dxl/protocol2/), registers, access and watchdog those of the X
series (https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/). `python test/servo_bus.py LINK` runs
it for good, LINK being the port of the driver.
"""

import os
import select
import struct
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from math import pi
from pathlib import Path

if __name__ == '__main__':
    sys.path.append(str(Path(__file__).resolve().parents[1] / 'examples'))

from arm_physics import ArmPhysics
from gear_physics import STEP_S

HEADER, BROADCAST, STATUS = b'\xff\xff\xfd\x00', 0xFE, 0x55
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
BAD_INSTRUCTION, BAD_CRC, BAD_RANGE, BAD_ACCESS = 0x02, 0x03, 0x04, 0x07  # errors of a status
MODEL, FIRMWARE = 1020, 48  # XM430-W350
TORQUE_ENABLE, WATCHDOG, GOAL, SPEED, POSITION = 64, 98, 116, 128, 132  # addresses
EEPROM = 64  # what lies before is locked while the torque is on
# Registers that may be written: size [bytes] and range.
WRITABLE = {
    7: (1, 0, 252), 8: (1, 0, 7), 9: (1, 0, 254), 11: (1, 0, 16), TORQUE_ENABLE: (1, 0, 1),
    65: (1, 0, 1), 68: (1, 0, 2), WATCHDOG: (1, 0, 127), 108: (4, 0, 32767), 112: (4, 0, 32767),
    GOAL: (4, 0, 4095)}
WATCHDOG_S = 0.02  # unit of the watchdog
CENTRE, RESOLUTION = 2048, 2.0 * pi / 4096  # position 0 [steps], a step [rad]
SPEED_STEP = 0.229 * 2.0 * pi / 60.0  # [rad/s]
LONGEST_S = 1.0  # of physics at once, however long the bus has slept


def crc16(data: bytes) -> int:
    """CRC-16 of Protocol 2.0: polynomial 0x8005, most significant bit first, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def packet(number: int, instruction: int, parameters: bytes) -> bytes:
    # A header within the packet is broken up by one more 0xfd.
    stuffed = (bytes((instruction,)) + parameters).replace(HEADER[:3], HEADER[:3] + b'\xfd')
    data = HEADER + struct.pack('<BH', number, len(stuffed) + 2) + stuffed
    return data + struct.pack('<H', crc16(data))


class Registers:
    """The control table of one servo."""

    def __init__(self, number: int) -> None:
        self.table = bytearray(256)
        self.table[0:2], self.table[6] = struct.pack('<H', MODEL), FIRMWARE
        self.table[7], self.table[8], self.table[9], self.table[11] = number, 3, 250, 3
        self.table[68] = 2

    def get(self, address: int) -> int:
        size = 4 if address in (GOAL, SPEED, POSITION) else 1
        return int.from_bytes(self.table[address:address + size], 'little', signed=size == 4)

    def put(self, address: int, value: int) -> None:
        size = 4 if address in (GOAL, SPEED, POSITION) else 1
        self.table[address:address + size] = value.to_bytes(size, 'little', signed=size == 4)

    def write(self, address: int, data: bytes) -> int:
        changes = {}
        while data:
            size, low, high = WRITABLE.get(address, (0, 0, 0))
            locked = address < EEPROM and self.table[TORQUE_ENABLE]
            if not size or len(data) < size or locked:
                return BAD_ACCESS
            value = int.from_bytes(data[:size], 'little', signed=size == 4)
            # Once the watchdog has stopped the servo, goals are refused until it is set to 0.
            if not low <= value <= high or (address == GOAL and self.table[WATCHDOG] == 255):
                return BAD_RANGE
            changes[address] = data[:size]
            address, data = address + size, data[size:]
        for place, new in changes.items():
            self.table[place:place + len(new)] = new
        return 0


class EmulatedBus:
    """Servos 1, 2, ... at the joints of an arm.

    clock: what time it is [s]; the arm moves on whenever the bus is spoken to. dead: servos that do
    not answer. spoilt: so many of the next statuses have a wrong byte.
    """

    def __init__(self, arm: ArmPhysics, clock: Callable[[], float] = time.monotonic) -> None:
        self.arm, self._clock = arm, clock
        self.servos = {i + 1: Registers(i + 1) for i in range(len(arm.joints))}
        self.dead: set[int] = set()
        self.spoilt = 0
        self._moved_to = self._spoken = clock()
        self._buffer = b''
        for number, servo in self.servos.items():
            servo.put(GOAL, CENTRE)
            arm.set_torque(number - 1, False)
        self._measure()

    def answer(self, data: bytes) -> bytes:
        self._buffer += data
        return b''.join(status for one in self._instructions() for status in self._carry_out(*one))

    def _instructions(self) -> Iterator[tuple[int, int, bytes]]:
        while True:
            start = self._buffer.find(HEADER)
            self._buffer = self._buffer[start:] if start >= 0 else self._buffer[-3:]
            if start < 0 or len(self._buffer) < 7:
                return
            number, length = struct.unpack('<BH', self._buffer[4:7])
            if len(self._buffer) < 7 + length:
                return
            whole, self._buffer = self._buffer[:7 + length], self._buffer[7 + length:]
            body = whole[7:-2].replace(HEADER[:3] + b'\xfd', HEADER[:3])
            if crc16(whole[:-2]) == struct.unpack('<H', whole[-2:])[0]:
                yield number, body[0], body[1:]
            elif number in self.servos:
                yield number, 0, bytes((BAD_CRC,))

    def _carry_out(self, number: int, instruction: int, parameters: bytes) -> Iterator[bytes]:
        self._move_on()
        if instruction == SYNC_WRITE:
            size = 1 + parameters[2]
            for k in range(4, len(parameters) - size + 1, size):
                self._write(parameters[k], parameters[:2] + parameters[k + 1:k + size])
        elif instruction == SYNC_READ:
            for one in parameters[4:]:
                # Each waits for the status before its own: a silent one silences the rest.
                if one not in self.servos or one in self.dead:
                    return
                yield self._read(one, parameters[:4])
        elif number == BROADCAST and instruction == PING:
            for one in sorted(self.servos.keys() - self.dead):
                yield self._status(one, 0, struct.pack('<HB', MODEL, FIRMWARE))
        elif number in self.servos and number not in self.dead:
            if instruction == PING:
                yield self._status(number, 0, struct.pack('<HB', MODEL, FIRMWARE))
            elif instruction == READ:
                yield self._read(number, parameters)
            elif instruction == WRITE:
                yield self._status(number, self._write(number, parameters))
            else:
                yield self._status(number, parameters[0] if not instruction else BAD_INSTRUCTION)

    def _read(self, number: int, parameters: bytes) -> bytes:
        address, size = struct.unpack('<HH', parameters)
        data = bytes(self.servos[number].table[address:address + size])
        return self._status(number, 0, data) if len(data) == size \
            else self._status(number, BAD_ACCESS)

    def _write(self, number: int, parameters: bytes) -> int:
        if number not in self.servos or number in self.dead:
            return 0
        servo, joint = self.servos[number], number - 1
        had_torque = servo.table[TORQUE_ENABLE]
        error = servo.write(struct.unpack('<H', parameters[:2])[0], parameters[2:])
        if servo.table[TORQUE_ENABLE] != had_torque:
            self.arm.set_torque(joint, not had_torque)
        self.arm.data.ctrl[joint] = (servo.get(GOAL) - CENTRE) * RESOLUTION
        return error

    def _status(self, number: int, error: int, parameters: bytes = b'') -> bytes:
        data = packet(number, STATUS, bytes((error,)) + parameters)
        if self.spoilt:
            self.spoilt -= 1
            data = data[:-3] + bytes((data[-3] ^ 0x10,)) + data[-2:]
        return data

    def _move_on(self) -> None:
        now = self._clock()
        steps = int((now - self._moved_to) / STEP_S)
        self._moved_to += steps * STEP_S
        if steps:
            self.arm.advance(min(steps * STEP_S, LONGEST_S))
        self._measure()
        for number, servo in self.servos.items():
            limit = servo.table[WATCHDOG]
            waits = servo.table[TORQUE_ENABLE] and 0 < limit < 255
            if waits and now - self._spoken > limit * WATCHDOG_S:
                servo.table[WATCHDOG] = 255
                servo.put(GOAL, servo.get(POSITION))
                self.arm.data.ctrl[number - 1] = (servo.get(GOAL) - CENTRE) * RESOLUTION
        self._spoken = now

    def _measure(self) -> None:
        for servo, y, speed in zip(
            self.servos.values(), self.arm.encoders(), self.arm.speeds, strict=True
        ):
            servo.put(POSITION, CENTRE + round(y / RESOLUTION))
            servo.put(SPEED, round(speed / SPEED_STEP))


class Port:
    """The bus as a serial port, a pseudo-terminal behind a link; closing pulls the plug."""

    def __init__(self, bus: EmulatedBus, link: Path) -> None:
        self._bus, self._link = bus, link
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._link.unlink(missing_ok=True)
        self._ends.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _serve(self) -> None:
        while not self._ends.is_set():
            if select.select([self._master], [], [], 0.05)[0]:
                os.write(self._master, self._bus.answer(os.read(self._master, 4096)))


if __name__ == '__main__':
    Port(EmulatedBus(ArmPhysics()), Path(sys.argv[1]))
    while True:
        time.sleep(1.0)
