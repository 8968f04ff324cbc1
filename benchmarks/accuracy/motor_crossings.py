"""How well the crossings of examples/simulated_motor.py have to be learned, in whatever time."""

from __future__ import annotations

import sys
from math import inf
from pathlib import Path
from typing import NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[2] / 'examples'))

from simulated_motor import C_L, C_R

LIMITS = {'auto': 0.01, 'false': 0.03}  # relative error, by estimator.use_applied_control
BOUND_S = 5.0  # from when on the error has to stay within


class CrossingError(NamedTuple):
    """How far an estimate is off, for that of c_r and c_l for which it is more.

    relative: to the true one. deviations: in units of the published one.
    """

    relative: float
    deviations: float


def crossing_error(c_r: float, c_l: float, std_c_r: float, std_c_l: float) -> CrossingError:
    """The error of an estimate of c_r and c_l with these deviations."""
    off_r, off_l = abs(c_r - C_R), abs(c_l - C_L)
    return CrossingError(
        max(off_r / C_R, off_l / -C_L),
        max(off / std if std else inf for off, std in ((off_r, std_c_r), (off_l, std_c_l))),
    )
