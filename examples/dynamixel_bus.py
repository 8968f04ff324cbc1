"""Dynamixel servos of the X series on one bus, through the SDK of their maker; no ROS."""

from __future__ import annotations

import contextlib
import math
import struct
import termios
import time
from collections.abc import Callable, Sequence

from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

# Registers: https://emanual.robotis.com/docs/en/dxl/x/xm430-w350/
TORQUE_ENABLE, WATCHDOG, GOAL, SPEED_AND_POSITION, POSITION = 64, 98, 116, 128, 132
STEP, CENTRE = 2.0 * math.pi / 4096, 2048  # of the encoder [rad]; where it says 0
SPEED_STEP = 0.229 * 2.0 * math.pi / 60.0  # [rad/s]
ALERT = 0x80  # in an answer: the servo has switched itself off
SILENT_AFTER = 3  # answers missed in a row
WATCHDOG_S, WATCHDOG_UNIT_S = 0.4, 0.02  # of the servos
UNPLUGGED = (OSError, termios.error)  # what pyserial raises


class PatientPort(PortHandler):
    """The port of the SDK, which by itself waits 34 ms for a lost packet and spins meanwhile."""

    def __init__(self, name: str, baud: int, patience_s: float) -> None:
        super().__init__(name)
        self._patience_ms = 1e3 * patience_s
        self.setBaudRate(baud)
        self.ser.timeout = patience_s

    def setPacketTimeout(self, packet_length: int) -> None:
        """Wait for as long as so many bytes take, and the patience."""
        self.setPacketTimeoutMillis(self.tx_time_per_byte * packet_length + self._patience_ms)


class ServoBus:
    """The servos, known by their IDs. goals: where the engaged ones were told to go [steps].

    Whatever it does raises one of UNPLUGGED where the port fails; `lose` it then.
    """

    def __init__(self, open_port: Callable[[], PatientPort], servos: Sequence[int]) -> None:
        self._open_port, self._servos, self._packets = open_port, servos, PacketHandler(2.0)
        self._port: PatientPort | None = None
        self._missed = dict.fromkeys(servos, 0)  # answers, in a row
        self._read_at = 0.0  # [s]
        self.goals: dict[int, int] = {}
        self.alerts: set[int] = set()

    def engage(self) -> None:
        """Engage whatever answers, where it stands."""
        self._port = self._port or self._open_port()
        for servo in [one for one in self._servos if one not in self.goals]:
            # Until its watchdog is set to 0, a servo that it has stopped takes no goal.
            if self._set(servo, WATCHDOG, 0):
                data, _, _ = self._packets.readTxRx(self._port, servo, POSITION, 4)
                if len(data) == 4 and self._set(servo, TORQUE_ENABLE, 1):
                    (position,) = struct.unpack('<i', bytes(data))
                    self._missed[servo], self.goals[servo] = 0, position
                    self.write({servo: position})
                    self._set(servo, WATCHDOG, round(WATCHDOG_S / WATCHDOG_UNIT_S))
        self._read_at = time.monotonic()

    def read(self) -> dict[int, tuple[float, float]]:
        """Position [rad] and speed [rad/s] of the engaged servos that answer."""
        before, self._read_at = self._read_at, time.monotonic()
        if self._read_at > before + 0.5 * WATCHDOG_S:
            self.goals = {}  # the watchdogs may have stopped them
        # Each waits for the answer before its own: whoever is silent is asked last.
        asked, readings = sorted(self.goals, key=lambda one: self._missed[one]), {}
        if asked:
            self._packets.syncReadTx(self._port, SPEED_AND_POSITION, 8, asked, len(asked), False)
        for servo in asked:
            data, result, error = self._packets.readRx(self._port, servo, 8)
            if result != COMM_SUCCESS or len(data) != 8:  # a late answer to something else
                self._missed[servo] += 1
                if self._missed[servo] >= SILENT_AFTER:
                    del self.goals[servo]
                break
            self._missed[servo] = 0
            speed, position = struct.unpack('<ii', bytes(data))
            readings[servo] = (position - CENTRE) * STEP, speed * SPEED_STEP
            (self.alerts.add if error & ALERT else self.alerts.discard)(servo)
        return readings

    def write(self, goals: dict[int, int]) -> None:
        """Tell engaged servos where to go [steps]."""
        if goals:
            data = b''.join(struct.pack('<Bi', *one) for one in goals.items())
            self._packets.syncWriteTxOnly(self._port, GOAL, 4, list(data), len(data))
            self.goals.update(goals)

    def lose(self) -> None:
        """Forget a port that has failed."""
        if self._port is not None:
            with contextlib.suppress(*UNPLUGGED):
                self._port.closePort()
        self._port, self.goals = None, {}

    def release(self) -> list[int]:
        """Switch all torque off; returns the servos that have not confirmed it."""
        if self._port is None:
            return list(self._servos)
        self._port.is_using = False  # as it is where a signal has broken into a packet
        return [one for one in self._servos if not any(
            self._set(one, TORQUE_ENABLE, 0) for _ in range(SILENT_AFTER)
        )]

    def _set(self, servo: int, address: int, value: int) -> bool:
        result, error = self._packets.write1ByteTxRx(self._port, servo, address, value)
        return result == COMM_SUCCESS and not error & ~ALERT
