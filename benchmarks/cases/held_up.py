"""The example driver and the controller in simulated time, both held up by other processes.

What a busy machine does to real processes, the same for the same seed and as often as wanted:
either of the two waits for the processor before it goes on, so that outputs are late or skipped,
commands come after the sample that they were for.
"""

import sys
from collections import deque
from math import inf
from pathlib import Path
from random import Random
from typing import NamedTuple
from unittest.mock import patch

sys.path.append(str(Path(__file__).resolve().parents[2] / 'examples'))

import simulated_motor
from simulated_motor import C_L, C_R

from backlash_ros.core import Estimate, Parameters, Status, build_reference
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter

# How long a process that wants to run waits: share of its turns at load 1, and longest wait [s] of
# a uniform distribution. Otherwise it waits for SHORT_WAIT_S on average.
WAITS = ((5e-3, 40e-3), (6e-2, 12e-3), (0.3, 4e-3))
SHORT_WAIT_S = 2e-4
TRANSPORT_S = (5e-5, 2e-4)  # shortest and longest time that a message is under way
CALL_S = 3e-5  # to read or to publish
ANSWER_S, NOTE_S = 3e-4, 1.2e-3  # from y to v, and for what is done about the sample after that


class Heard(NamedTuple):
    """What an answer told: when it was given [s since the start], and the estimate."""

    time_s: float
    estimate: Estimate

    @property
    def error(self) -> float:
        """Of c_r or c_l, relative to the true one, the larger."""
        e = self.estimate
        return max(abs(e.c_r / C_R - 1.0), abs(e.c_l / C_L - 1.0))

    @property
    def wrong(self) -> bool:
        """Whether it is *tracking*, off by 1 % of the gap and by five published deviations."""
        e = self.estimate
        off_r, off_l = abs(e.c_r - C_R), abs(e.c_l - C_L)
        beyond = not (off_r <= 5.0 * e.std_c_r and off_l <= 5.0 * e.std_c_l)
        return e.status is Status.TRACKING and beyond and max(off_r, off_l) > 0.01 * (C_R - C_L)


class HeldUpProcesses:
    """One run of both. load: how often they wait, 0 for an idle machine; reports: of v applied."""

    def __init__(self, p: Parameters, load: float, seed: int, reports: bool) -> None:
        self.period, self._reports = p.sample_period, reports
        self._load, self._random, self._now = load, Random(seed), 0.0
        self.loop = ControlLoop(p, Driver(lambda: _ns(self._now)), None,
                                SampleCounter(self.period, False))
        self._reference = build_reference(p)
        # Of the driver: when it samples next, the number of the sample, and a command on its way.
        self._due, self._number = self.period, 0
        self._command: tuple[float, float] | None = None
        self._driver_at, self._controller_at = self._due + self._wait(), inf
        # Of the controller: y, when it left and when it arrives, its number.
        self._outputs: deque[tuple[float, float, float, int]] = deque()
        self._free = 0.0  # when it has done its last turn

    def run(self, seconds: float) -> list[Heard]:
        heard = []
        with patch.object(simulated_motor, 'time', self):
            motor = simulated_motor.SimulatedMotor(self.period)
            while (now := min(self._driver_at, self._controller_at)) < seconds:
                driver_first, self._now = self._driver_at <= self._controller_at, now
                if driver_first:
                    self._drive(motor)
                elif self._control():
                    heard.append(Heard(self._now, self.loop.estimate))
        return heard

    def monotonic(self) -> float:
        """Simulated time [s]: the clock of the motor."""
        return self._now

    def _wait(self) -> float:
        turn = self._random.random()
        for share, longest in WAITS:
            turn -= share * self._load
            if turn < 0.0:
                return self._random.uniform(0.0, longest)
        return self._random.expovariate(1.0 / SHORT_WAIT_S)

    def _drive(self, motor: simulated_motor.SimulatedMotor) -> None:
        """A turn of the driver: the timer first, then the newest command."""
        if self._now >= self._due:
            y = motor.load_encoder()
            if self._reports:
                self.loop.take_applied(motor.motor_encoder(), _ns(self._now))
            self._now += CALL_S
            self._number += 1
            arrives = self._now + self._random.uniform(*TRANSPORT_S)
            self._outputs.append((y, self._now, arrives, self._number))
            if self._controller_at == inf:
                self._controller_at = max(arrives, self._free) + self._wait()
            # A timer leaves out what it has missed.
            self._due += self.period * (1 + max(int((self._now - self._due) / self.period), 0))
        if self._command is not None and self._command[0] <= self._now:
            motor.move_to(self._command[1])
            self._command = None
            self._now += CALL_S
        arrives = inf if self._command is None else self._command[0]
        self._driver_at = max(self._now, min(self._due, arrives)) + self._wait()

    def _control(self) -> bool:
        """A turn of the controller; returns whether it has answered."""
        y, left, _, number = self._outputs.popleft()
        output = Output(y, _ns(left), _ns(left), _ns(self._now), number)
        self.loop.take_reference(self._reference(self._now))
        step = self.loop.answer(output)
        if step is not None:
            self.loop.note_answer(step, output)
        self._now += ANSWER_S
        if step is not None:
            arrives = self._now + self._random.uniform(*TRANSPORT_S)
            self._command = arrives, step.v
            self._driver_at = min(self._driver_at, arrives + self._wait())
        behind = bool(self._outputs) and self._outputs[0][2] < self._now - self.period
        if step is not None and not behind:
            self.loop.core.refine()
            self._now += NOTE_S
        self._free = self._now
        self._controller_at = max(self._now, self._outputs[0][2]) + self._wait() \
            if self._outputs else inf
        return step is not None


def _ns(seconds: float) -> int:
    """Time as a stamp; 100 s are added, as nothing begins at 0."""
    return round((100.0 + seconds) * 1e9)
