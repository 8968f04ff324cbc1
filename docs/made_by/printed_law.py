"""What the printed update law (3.11) does on the paper's example, u being known exactly."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from math import isfinite, sin

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.structure import ControlInput, Proportional
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.law import Law
from backlash_ros.core.laws.lms_and_printed import printed_c, printed_f, printed_m
from backlash_ros.core.plant.backlash import Backlash

PERIOD = 0.01
TRUE = (1.3, 3.0, -3.0)
START = Estimate(0.696, 0.5, -0.5, 0.22)


def updated(old: Estimate, u: float, y_m: float, w: float) -> Estimate:
    """One step of the law, with the newest values. w: the crossing of the engaged side."""
    f = printed_f(u, y_m, old.m, w)
    m = printed_m(u, y_m, f, w)
    return replace(old, m=m, f=f, **{'c_r' if w == old.c_r else 'c_l': printed_c(u, y_m, f, m)})


def reference(k: int) -> float:
    """y_m of the paper at sample k."""
    return 10.0 * sin(12.6 * k * PERIOD)


def command(y_m: float, estimate: Estimate, inverse: BacklashInverse) -> float:
    """u_d of (3.2), with the inverse (2.3)."""
    return Proportional().control(ControlInput(y_m, 0.0, estimate, Law()), inverse)


def estimates() -> Iterator[Estimate]:
    """Backlash, structure (3.2), inverse (2.3) and the law without guards; no plant is needed."""
    backlash, inverse, e, w, u = Backlash(*TRUE), BacklashInverse(), START, START.c_r, 0.0
    for k in count():
        command(reference(k), e, inverse)
        before, u = u, backlash.step(inverse.v)
        if u != before:
            w = e.c_r if u > before else e.c_l
        e = updated(e, u, reference(k), w)
        yield e


def first_not_finite() -> tuple[int, str]:
    """Sample, from 1 on, and name of the first quotient that the unguarded law cannot form."""
    return next((k, name) for k, e in enumerate(estimates(), 1)
                for name in ('f', 'm', 'c_r', 'c_l') if not isfinite(getattr(e, name)))


def error_growth(f: float) -> float:
    """Measured ratio of two errors e in a row, m and f being right and c_r off by 1e-6."""
    m, c_r, c_l = TRUE
    backlash, inverse = Backlash(*TRUE), BacklashInverse()
    c, errors = c_r + 1e-6, []
    for y_m in (10.0, 10.1, 10.2):  # rises, so that the right side stays engaged
        u_d = command(y_m, Estimate(m, c, c_l, f), inverse)
        u = backlash.step(inverse.v)
        errors.append(u - u_d)
        c = printed_c(u, y_m, f, m)
    return errors[-1] / errors[-2]
