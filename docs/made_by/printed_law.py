"""What the printed update law (3.11) does on the paper's example, u being known exactly."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from math import isfinite, pi, sin
from typing import NamedTuple

import numpy as np

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.paper_structure import Proportional
from backlash_ros.core.control.protocol import Command, ControlInput
from backlash_ros.core.estimate import Bounds, Estimate
from backlash_ros.core.laws.printed_law import printed_c, printed_f, printed_m
from backlash_ros.core.plant.backlash import Backlash

PERIOD = 0.01
TRUE = (1.3, 3.0, -3.0)
START = Estimate(0.696, 0.5, -0.5, 0.22)
BOUNDS, F_BOUNDS = Bounds(c_r=(0.0, 100.0), c_l=(-100.0, 0.0)), (-0.5, 0.5)


class Reading(NamedTuple):
    """One way to read (3.11).

    newest: each quotient is evaluated with the newest values, else all with the old ones.
    relaxation: share of the way to the new value that is taken. learns_f: whether f is updated.
    guarded: skips quotients that are not finite, and keeps the estimates in their bounds.
    """

    newest: bool = True
    relaxation: float = 1.0
    learns_f: bool = True
    guarded: bool = True

    def taken(self, old: float, new: float, bounds: tuple[float, float]) -> float:
        """What becomes of an estimate."""
        if not self.guarded or not isfinite(new):
            return old if self.guarded else new
        return min(max(old + self.relaxation * (new - old), bounds[0]), bounds[1])

    def updated(self, old: Estimate, u: float, y_m: float, w: float) -> Estimate:
        """One step of the law. w: the crossing of the side that is engaged."""
        f = self.taken(old.f, printed_f(u, y_m, old.m, w), F_BOUNDS) if self.learns_f else old.f
        used_f = f if self.newest else old.f
        m = self.taken(old.m, printed_m(u, y_m, used_f, w), BOUNDS.m)
        c = printed_c(u, y_m, used_f, m if self.newest else old.m)
        if w == old.c_r:
            return replace(old, m=m, c_r=self.taken(old.c_r, c, BOUNDS.c_r), f=f)
        return replace(old, m=m, c_l=self.taken(old.c_l, c, BOUNDS.c_l), f=f)


def reference(k: int) -> float:
    """y_m of the paper at sample k."""
    return 10.0 * sin(12.6 * k * PERIOD)


def command(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> Command:
    """(3.2) with the inverse (2.3)."""
    return Proportional().control(ControlInput(y_m, 0.0, estimate, np.zeros(0)), inverse)


def estimates(reading: Reading) -> Iterator[Estimate]:
    """Backlash, structure (3.2), inverse (2.3) and one reading of (3.11); no plant is needed."""
    backlash, inverse, e, w, u = Backlash(*TRUE), BacklashInverse(), START, START.c_r, 0.0
    for k in count():
        before, u = u, backlash.step(command(reference(k), e, inverse).v)
        if u != before:
            w = e.c_r if u > before else e.c_l
        e = reading.updated(e, u, reference(k), w)
        yield e


def last_estimate(reading: Reading, seconds: float) -> Estimate:
    """Estimate at the end of a run on the paper's example."""
    return next(islice(estimates(reading), round(seconds / PERIOD) - 1, None))


def first_not_finite() -> tuple[int, str]:
    """Sample, from 1 on, and name of the first quotient that the unguarded law cannot form."""
    return next((k, name) for k, e in enumerate(estimates(Reading(guarded=False)), 1)
                for name in ('f', 'm', 'c_r', 'c_l') if not isfinite(getattr(e, name)))


def moves_after_the_first() -> dict[str, tuple[float, float]]:
    """How far m and c move: with the newest f, and with all values old; means of |change|.

    u is what the backlash makes of the v of the first guess, over one period and where the
    guess names the region rightly.
    """
    backlash, inverse, e = Backlash(*TRUE), BacklashInverse(), START
    moves, u = [], 0.0
    for k in range(round(4.0 * pi / 12.6 / PERIOD)):
        y_m, before = reference(k), u
        u = backlash.step(command(y_m, e, inverse).v)
        if abs(u - before) >= 1e-9:
            w = e.c_r if u > before else e.c_l
            moves.append([(printed_m(u, y_m, f, w) - e.m, printed_c(u, y_m, f, e.m) - w)
                          for f in (printed_f(u, y_m, e.m, w), e.f)])
    newest, old = np.abs(moves).mean(axis=0)
    return {name: (float(newest[i]), float(old[i])) for i, name in enumerate(('m', 'c'))}


def error_growth(f: float) -> float:
    """Measured ratio of two errors e in a row, m and f being right and c_r off by 1e-6."""
    m, c_r, c_l = TRUE
    backlash, inverse = Backlash(*TRUE), BacklashInverse()
    c, errors = c_r + 1e-6, []
    for y_m in (10.0, 10.1, 10.2):  # rises, so that the right side stays engaged
        given = command(y_m, Estimate(m, c, c_l, f), inverse)
        u = backlash.step(given.v)
        errors.append(u - given.u_d)
        c = printed_c(u, y_m, f, m)
    return errors[-1] / errors[-2]
