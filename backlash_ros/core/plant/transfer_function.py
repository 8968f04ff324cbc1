"""The known linear part G(z) = numerator / denominator, its state space, and checks of it."""

from collections.abc import Sequence
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import ParameterError

Array = NDArray[np.float64]
Roots = NDArray[np.complex128]

ON_CIRCLE = 1e-6  # distance from the unit circle, from 0, or between two roots that counts as 0


class TransferFunction:
    """G(z) with at least one sample of delay, coefficients in descending powers of z.

    numerator, denominator: plain sequences of floats; leading zeros of the numerator are dropped.
    group: of the parameters, for error messages. Raises ParameterError for empty, non-finite or
    zero polynomials and for a G(z) without delay.
    """

    def __init__(
        self, numerator: Sequence[float], denominator: Sequence[float], group: str = 'plant',
    ) -> None:
        b = _polynomial(f'{group}.numerator', numerator)
        a = _polynomial(f'{group}.denominator', denominator)
        if len(b) >= len(a):
            raise ParameterError(
                f'{group}.numerator', list(numerator), f'has degree {len(b) - 1}, must be below '
                f'the degree {len(a) - 1} of {group}.denominator',
                'a sampled plant has a delay of at least one sample')
        self.numerator = np.concatenate([np.zeros(len(a) - len(b)), b]) / a[0]
        self.denominator = a / a[0]
        self.order = len(a) - 1
        self._terms = tuple(zip(
            (-self.denominator[1:]).tolist(), self.numerator[1:].tolist(), strict=True))

    @cached_property
    def poles(self) -> Roots:
        return np.asarray(np.roots(self.denominator), dtype=np.complex128)

    @property
    def delay(self) -> int:
        """Samples between u and its first effect on y."""
        return int(np.flatnonzero(self.numerator)[0])

    @property
    def group_delay(self) -> float:
        """Delay of slow motion [samples]; not finite if G has a zero or a pole at z = 1."""
        b, a = self.numerator, self.denominator
        return float(np.polyval(np.polyder(a), 1.0) / a.sum()
                     - np.polyval(np.polyder(b), 1.0) / b.sum())

    def response(self, z: Roots) -> Roots:
        """G at the points z."""
        return np.asarray(np.polyval(self.numerator, z) / np.polyval(self.denominator, z))

    def equals(self, other: 'TransferFunction') -> bool:
        return np.array_equal(self.numerator, other.numerator) \
            and np.array_equal(self.denominator, other.denominator)

    def without_delay(self) -> tuple[list[float], list[float], int]:
        """Return b, a and the largest d [samples] with G = z^-d b/a where b/a still has a delay."""
        size = len(self.denominator)
        delay = min(size - len(np.trim_zeros(self.denominator, 'b')), self.delay - 1)
        b, a = np.trim_zeros(self.numerator, 'f'), self.denominator[:size - delay]
        return b.tolist(), a.tolist(), delay

    def state_space(self) -> tuple[Array, Array, Array]:
        """Return A (n, n), B, C (n,) of x(k+1) = A x + B u, y = C x in observer form: x_0 is y."""
        n = self.order
        a = np.eye(n, k=1)
        a[:, 0] = -self.denominator[1:]
        return a, self.numerator[1:].copy(), np.eye(n)[0]

    def advance(self, x: list[float], u: float) -> float:
        """Advance a state in observer form by one sample, in place, and return the new y."""
        y, last = x[0], len(x) - 1  # for so few numbers NumPy takes longer
        for i, (a, b) in enumerate(self._terms):
            x[i] = (x[i + 1] if i < last else 0.0) + a * y + b * u
        return x[0]


class Family(Protocol):
    """Plants b / a to be fitted, with K = count unknown parameters xi."""

    @property
    def count(self) -> int: ...

    @property
    def leaks(self) -> int:
        """Number of first xi with a fixed prior N(0, 1); the others share the unknown scale s."""

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        """b, a of y(k) = sum b_i u(k-i) - sum a_i y(k-i), equally long; u(k) acts before y(k)."""

    def slopes(self, xi: list[float]) -> tuple[Array, Array]:
        """Derivatives of b and of a by each xi, both of shape (K, n + 1)."""


class StateModel:
    """x(k+1) = A x + B u, y = c x_0 with observability Gramian I over a finite horizon.

    A unit state in any direction then has the same energy in y, so that one number describes the
    uncertainty of x, and covariances stay well scaled however close the poles of G lie to 1.
    to_state: matrix from observer form. memory: samples in which the slowest stable mode decays.
    equilibrium: x at rest with y = 1, shape (n,).
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
        self.to_state: Array = np.asarray(rotation.T @ r, np.float64)
        self.to_observer: Array = np.asarray(np.linalg.inv(self.to_state), np.float64)
        self.a: Array = self.to_state @ a @ self.to_observer
        self.b: Array = self.to_state @ b
        self.c = float(triangle[0, 0])
        stable = [abs(pole) for pole in model.poles if abs(pole) < 1.0 - ON_CIRCLE]
        self.memory = memory_of(max(stable, default=0.0))
        rest = np.block([[self.a - np.eye(n), self.b[:, None]], [self.c * np.eye(1, n + 1)]])
        self.equilibrium: Array = np.linalg.lstsq(rest, np.eye(n + 1)[n])[0][:n]


def memory_of(slowest: float) -> int:
    """Return the samples in which a mode with a pole of this magnitude decays, 150 to 5000."""
    return int(min(max(3.0 / (1.0 - slowest), 150), 5000))


def powers(a: Array, b: Array, count: int) -> Array:
    """Stack `count` terms of b, a b, a^2 b, ... for a (n, n) and b (n,) or (n, m)."""
    stack, factor = b[None], a
    while len(stack) < count:
        stack = np.concatenate([stack, factor @ stack if b.ndim > 1 else stack @ factor.T])
        factor = factor @ factor
    return stack[:count]


def check_model(model: TransferFunction) -> None:
    """Raise ParameterError, with the reason, if m, c_r, c_l cannot be learned through this G."""
    poles, numerator = model.poles, model.numerator.tolist()
    for pole in poles:
        if abs(pole) > 1.0 + ON_CIRCLE:
            raise ParameterError(
                'plant.denominator', model.denominator.tolist(),
                f'has the unstable pole {_text(pole)}',
                'turn it around if its powers of z ascend, else close a stabilising loop around '
                'the plant first and give its G(z)',
            )
    for zero in np.roots(model.numerator):
        near = poles[np.abs(poles - zero) < ON_CIRCLE]
        if near.size and abs(zero) > 1.0 - ON_CIRCLE:
            raise ParameterError(
                'plant.numerator', numerator,
                f'cancels the pole {_text(near[0])}, which then cannot be seen in y',
                'cancel the common factor in numerator and denominator',
            )
        if abs(zero - 1.0) < ON_CIRCLE:
            raise ParameterError(
                'plant.numerator', numerator,
                'has a zero at z = 1: a constant u leaves no trace in y, nor do c_r and c_l',
                'measure an output that responds to a constant input',
            )


def model_warnings(
    model: TransferFunction, sample_period: float, frequency: float | None = None,
) -> list[str]:
    """Return what makes the estimate ill-conditioned; frequency: of the reference [rad/s]."""
    poles = model.poles
    slow = [_text(pole) for pole in poles if ON_CIRCLE < 1.0 - abs(pole) < 1e-4]
    circle = [_text(zero) for zero in np.roots(model.numerator) if abs(abs(zero) - 1.0) < 1e-3]
    samples = 2.0 * np.pi / (frequency * sample_period) if frequency is not None else 100.0
    return [text for true, text in (
        (slow, f'the pole {"".join(slow[:1])} is slower than 10000 samples: sample_period='
               f'{sample_period:g} s is short for this plant'),
        (np.count_nonzero(np.abs(poles - 1.0) < 1e-3) > 1,
         'G(z) integrates more than once: y drifts fast while u is not yet right'),
        (circle, f'the zero {"".join(circle[:1])} lies on the unit circle: motion of u at that '
                 'frequency does not show in y'),
        (np.linalg.cond(StateModel(model).to_observer) > 1e9,
         'the coefficients of G(z) determine its states badly: give more digits, or a longer '
         'sample_period'),
        (not 10.0 <= samples <= 1e5,
         f'frequency={frequency or 0.0:g} rad/s has {samples:.3g} samples per period, between 10 '
         'and 100000 are sensible: change sample_period'),
    ) if true]


def _text(root: complex) -> str:
    return f'{root.real:.6g}' if abs(root.imag) < 1e-9 else f'{root:.6g}'


def _polynomial(name: str, coefficients: Sequence[float]) -> Array:
    values = np.asarray(coefficients, dtype=np.float64)
    for wrong, rule in (
        (values.ndim != 1 or values.size == 0, 'must be a list of at least one number'),
        (not np.isfinite(values).all(), 'must be finite'),
        (not values.any(), 'must not be zero'),
        (name.endswith('.denominator') and not values.flat[:1].all(),
         'must have a leading coefficient other than 0'),
    ):
        if wrong:
            raise ParameterError(name, coefficients, rule)
    return np.trim_zeros(values, 'f')
