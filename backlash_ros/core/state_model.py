"""State space of G(z) in coordinates that suit estimation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from backlash_ros.core.transfer_function import TransferFunction

Array = NDArray[np.float64]


class StateModel:
    """x(k+1) = A x + B u, y = C x with observability Gramian I over a finite horizon.

    A unit state in any direction then shows with the same energy in y, so that one number tells
    how unknown x is, and covariances stay well scaled however close the poles of G lie to 1.
    """

    def __init__(self, model: TransferFunction) -> None:
        a, b, c = model.state_space()
        self.order = model.order
        rows, row = [], c
        for _ in range(_horizon(model)):
            rows.append(row)
            row = row @ a
        # R of the observability matrix: R' R is its Gramian, without squaring the condition.
        r = linalg.qr(np.array(rows), mode='r')[0][: self.order]
        self.to_observer = linalg.inv(r)
        self.a: Array = r @ a @ self.to_observer
        self.b: Array = r @ b
        self.c: Array = c @ self.to_observer


def _horizon(model: TransferFunction) -> int:
    """Samples within which the slow dynamics show, bounded for integrators."""
    return max(10 * model.order, 50)
