"""State space of G(z) in coordinates that suit estimation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]


class StateModel:
    """x(k+1) = A x + B u, y = c x_0 with observability Gramian I over a finite horizon.

    A unit state in any direction then shows with the same energy in y, so that one number tells
    how unknown x is, and covariances stay well scaled however close the poles of G lie to 1.
    Only the first state shows in y at once: its factor c is all there is of C. memory: samples
    after which the slowest stable mode has died out. equilibrium: x at rest with y = 1, shape (n,):
    a constant u holds it, none in an integrator.
    """

    def __init__(self, model: TransferFunction) -> None:
        self.transfer_function = model
        a, b, c = model.state_space()
        n = self.order = model.order
        # A horizon within which the slow dynamics show, bounded for integrators.
        rows = [c]
        while len(rows) < max(10 * n, 50):
            rows.append(rows[-1] @ a)
        # R of the observability matrix: R' R is its Gramian, without squaring the condition.
        r = np.linalg.qr(np.array(rows))[1]
        # A rotation keeps the Gramian and turns C onto the first axis.
        rotation, triangle = np.linalg.qr(np.linalg.solve(r.T, c)[:, None], mode='complete')
        # From the observer form, whose first state is y.
        self.to_state: Array = np.asarray(rotation.T @ r, np.float64)
        self.to_observer: Array = np.asarray(np.linalg.inv(self.to_state), np.float64)
        self.a: Array = self.to_state @ a @ self.to_observer
        self.b: Array = self.to_state @ b
        self.c = float(triangle[0, 0])
        stable = [abs(pole) for pole in model.poles if abs(pole) < 1.0 - 1e-6]
        self.memory = memory_of(max(stable, default=0.0))
        rest = np.zeros((n + 1, n + 1))
        rest[:n, :n], rest[:n, n], rest[n, 0] = self.a - np.eye(n), self.b, self.c
        self.equilibrium: Array = np.linalg.lstsq(rest, np.eye(n + 1)[n])[0][:n]


def memory_of(slowest: float) -> int:
    """Samples after which a mode has died out whose pole has this size, within reason."""
    return int(min(max(3.0 / (1.0 - slowest), 150), 5000))


def powers(a: Array, b: Array, count: int) -> Array:
    """b, a b, a^2 b, ... for a (n, n) and b (n,) or (n, m), stacked `count` high."""
    stack, factor = b[None], a
    while len(stack) < count:
        stack = np.concatenate([stack, factor @ stack if b.ndim > 1 else stack @ factor.T])
        factor = factor @ factor
    return stack[:count]
