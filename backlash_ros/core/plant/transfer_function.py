"""The known linear part G(z) = numerator / denominator, and its state space for estimation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import ParameterError

Array = NDArray[np.float64]


class TransferFunction:
    """G(z) with at least one sample of delay, coefficients in descending powers of z.

    numerator, denominator: plain sequences of floats; leading zeros of the numerator are dropped.
    group: of parameters that errors speak of. Raises ParameterError for empty, non-finite or zero
    polynomials and for a G(z) without delay.
    """

    def __init__(
        self, numerator: Sequence[float], denominator: Sequence[float], group: str = 'plant',
    ) -> None:
        b = _polynomial(f'{group}.numerator', numerator)
        a = _polynomial(f'{group}.denominator', denominator)
        if len(b) >= len(a):
            raise ParameterError(
                f'{group}.numerator', list(numerator),
                f'has degree {len(b) - 1}, must be below the degree {len(a) - 1} of '
                f'{group}.denominator',
                'a sampled plant has a delay of at least one sample',
            )
        self.numerator = np.concatenate([np.zeros(len(a) - len(b)), b]) / a[0]
        self.denominator = a / a[0]
        self._terms = tuple(zip(
            (-self.denominator[1:]).tolist(), self.numerator[1:].tolist(), strict=True
        ))

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.denominator) - 1

    @cached_property
    def poles(self) -> NDArray[np.complex128]:
        """Roots of the denominator, shape (n,)."""
        return np.asarray(np.roots(self.denominator), dtype=np.complex128)

    @property
    def zeros(self) -> NDArray[np.complex128]:
        """Roots of the numerator."""
        return np.asarray(np.roots(self.numerator), dtype=np.complex128)

    @property
    def delay(self) -> int:
        """Samples between u and its first effect on y."""
        return int(np.flatnonzero(self.numerator)[0])

    def response(self, z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """G at the points z."""
        value = np.polyval(self.numerator, z) / np.polyval(self.denominator, z)
        return np.asarray(value, dtype=np.complex128)

    def without_delay(self) -> tuple[list[float], list[float], int]:
        """Numerator, denominator and delay [samples] of z^-delay numerator / denominator.

        The whole delay, as far as the rest is still a G(z) that one can be told.
        """
        numerator = np.trim_zeros(self.numerator, 'f')
        at_zero = len(self.denominator) - len(np.trim_zeros(self.denominator, 'b'))
        delay = min(at_zero, self.delay - 1)
        denominator = self.denominator[:len(self.denominator) - delay]
        return numerator.tolist(), denominator.tolist(), delay

    def state_space(self) -> tuple[Array, Array, Array]:
        """Return A (n, n), B (n,), C (n,) of x(k+1) = A x + B u, y = C x in observer form.

        In observer form the first state is y itself.
        """
        n = self.order
        a = np.zeros((n, n))
        a[:, 0] = -self.denominator[1:]
        a[:-1, 1:] = np.eye(n - 1)
        return a, self.numerator[1:].copy(), np.eye(n)[0]

    def advance(self, x: list[float], u: float) -> float:
        """Take a state in the observer form over one sample, in place, and return its y.

        Beside so few numbers a call of NumPy takes longer.
        """
        y = x[0]
        last = len(x) - 1
        for i, (a, b) in enumerate(self._terms):
            x[i] = (x[i + 1] if i < last else 0.0) + a * y + b * u
        return x[0]


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


def _polynomial(name: str, coefficients: Sequence[float]) -> Array:
    values = np.asarray(coefficients, dtype=np.float64)
    if values.ndim != 1 or values.size == 0:
        raise ParameterError(name, coefficients, 'must be a list of at least one number')
    if not np.isfinite(values).all():
        raise ParameterError(name, coefficients, 'must be finite')
    if not values.any():
        raise ParameterError(name, coefficients, 'must not be zero')
    if name.endswith('.denominator') and values[0] == 0.0:
        raise ParameterError(name, coefficients, 'must have a leading coefficient other than 0')
    return np.trim_zeros(values, 'f')
