"""What the printed update law (3.11) does on the paper's example, u being known exactly."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, sin

import numpy as np

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.paper_structure import Proportional
from backlash_ros.core.control.protocol import ControlInput
from backlash_ros.core.estimate import Bounds, Estimate
from backlash_ros.core.laws.printed_law import printed_c, printed_f, printed_m
from backlash_ros.core.plant.backlash import Backlash

PERIOD = 0.01
TRUE = (1.3, 3.0, -3.0)
START = Estimate(0.696, 0.5, -0.5, 0.22)
F_BOUNDS = (-0.5, 0.5)
NO_STATE = np.zeros(0)


@dataclass(frozen=True)
class Reading:
    """One way to read (3.11).

    newest: each quotient is evaluated with the newest values, else all with the old ones.
    relaxation: share of the way to the new value that is taken. learns_f: whether f is updated.
    guarded: skips quotients that are not finite, and keeps the estimates in their bounds.
    """

    newest: bool = True
    relaxation: float = 1.0
    learns_f: bool = True
    guarded: bool = True


class PrintedLoop:
    """Backlash, structure (3.2), inverse (2.3) and one reading of (3.11); no plant is needed."""

    def __init__(self, reading: Reading, start: Estimate = START) -> None:
        self.estimate = start
        self._reading = reading
        self._bounds = Bounds(c_r=(0.0, 100.0), c_l=(-100.0, 0.0))
        self._backlash, self._inverse = Backlash(*TRUE), BacklashInverse()
        self._w, self._u = start.c_r, 0.0

    def step(self, y_m: float) -> float:
        """Go on by one sample and return the control error e = u - u_d (3.4)."""
        inputs = ControlInput(y_m, 0.0, self.estimate, NO_STATE)
        command = Proportional().control(inputs, self._inverse)
        u = self._backlash.step(command.v)
        if u != self._u:
            self._w = self.estimate.c_r if u > self._u else self.estimate.c_l
        self._u = u
        self.estimate = self._updated(u, y_m)
        return u - command.u_d

    def _updated(self, u: float, y_m: float) -> Estimate:
        old, r = self.estimate, self._reading
        f = old.f
        if r.learns_f:
            f = self._taken(old.f, printed_f(u, y_m, old.m, self._w), F_BOUNDS)
        used_f = f if r.newest else old.f
        m = self._taken(old.m, printed_m(u, y_m, used_f, self._w), self._bounds.m)
        c = printed_c(u, y_m, used_f, m if r.newest else old.m)
        if self._w == old.c_r:
            c_r = self._taken(old.c_r, c, self._bounds.c_r)
            return replace(old, m=m, c_r=c_r, f=f)
        return replace(old, m=m, c_l=self._taken(old.c_l, c, self._bounds.c_l), f=f)

    def _taken(self, old: float, new: float, bounds: tuple[float, float]) -> float:
        if not self._reading.guarded:
            return new
        if not isfinite(new):
            return old
        return min(max(old + self._reading.relaxation * (new - old), bounds[0]), bounds[1])


def reference(k: int) -> float:
    """y_m of the paper at sample k."""
    return 10.0 * sin(12.6 * k * PERIOD)


def last_estimate(reading: Reading, seconds: float) -> Estimate:
    """Estimate at the end of a run on the paper's example."""
    loop = PrintedLoop(reading)
    for k in range(round(seconds / PERIOD)):
        loop.step(reference(k))
    return loop.estimate


def first_not_finite() -> tuple[int, str]:
    """Sample, from 1 on, and name of the first quotient that the unguarded law cannot form."""
    loop = PrintedLoop(Reading(guarded=False))
    for k in range(1000):
        loop.step(reference(k))
        for name in ('f', 'm', 'c_r', 'c_l'):
            if not isfinite(getattr(loop.estimate, name)):
                return k + 1, name
    raise AssertionError('the unguarded law stayed finite')


def moves_after_the_first() -> dict[str, tuple[float, float]]:
    """How far m and c move: with the newest f, and with all values old; means of |change|.

    u is what the backlash makes of the v of the first guess, over one period and where the
    guess names the region rightly.
    """
    backlash, inverse = Backlash(*TRUE), BacklashInverse()
    e = START
    newest, old = [], []
    before = 0.0
    for k in range(round(4.0 * np.pi / 12.6 / PERIOD)):
        y_m = reference(k)
        u = backlash.step(Proportional().control(ControlInput(y_m, 0.0, e, NO_STATE), inverse).v)
        moved, before = u - before, u
        if abs(moved) < 1e-9:
            continue
        w = e.c_r if moved > 0.0 else e.c_l
        f = printed_f(u, y_m, e.m, w)
        newest.append((printed_m(u, y_m, f, w) - e.m, printed_c(u, y_m, f, e.m) - w))
        old.append((printed_m(u, y_m, e.f, w) - e.m, printed_c(u, y_m, e.f, e.m) - w))
    means = [np.mean(np.abs(np.array(rows)), axis=0) for rows in (newest, old)]
    return {name: (float(means[0][i]), float(means[1][i])) for i, name in enumerate(('m', 'c'))}


def error_growth(f: float) -> float:
    """Measured ratio of two errors e in a row, m and f being right and c_r off by 1e-6."""
    m, c_r, c_l = TRUE
    backlash, inverse = Backlash(*TRUE), BacklashInverse()
    c, errors = c_r + 1e-6, []
    for y_m in (10.0, 10.1, 10.2):  # rises, so that the right side stays engaged
        inputs = ControlInput(y_m, 0.0, Estimate(m, c, c_l, f), NO_STATE)
        command = Proportional().control(inputs, inverse)
        u = backlash.step(command.v)
        errors.append(u - command.u_d)
        c = printed_c(u, y_m, f, m)
    return errors[-1] / errors[-2]
