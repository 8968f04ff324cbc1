"""A G(z) that differs from a known one as real plants do: resonance, damping, dead time.

With the zero-order hold, G(z) without its delay is the sampled response of one G(s):

    poles        s_i = log(z_i), per sample; z = 1 stays an integrator, z = 0 stays a delay
    numerator    that of G(z) is linear in that of G(s): n numerators s^j make the matrix
    frequency    G(s / f) / f^k with k integrators: gain at rest, or of the velocity, is kept
    damping      s^2 + 2 d w s + w^2 with kappa d for d, d >= 1 makes two real poles; the numerator
                 of G(s), and with it the gain at rest, is kept
    dead time    of u, in front of G: exact for a u that is held over each sample

so that the zeros are those of the altered G(s), sampled.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]
Roots = NDArray[np.complex128]

NEAR = 1e-6  # distance of two roots that counts as none: rounding moves a double one by 1e-8
WHOLE = 1e-9  # share of a sample by which a whole number of them may be missed
CURE = 'give truth.numerator and truth.denominator instead'


@dataclass(frozen=True)
class Alteration:
    """What sets the true G(z) apart from the known one; the defaults change nothing.

    frequency: factor on the natural frequency of every pole, > 0. damping: factor on the damping
    ratio of every complex pair of poles, > 0. lag: dead time of u [samples], >= 0.
    """

    frequency: float = 1.0
    damping: float = 1.0
    lag: float = 0.0


def delayed(model: TransferFunction, samples: int) -> TransferFunction:
    """z^-samples G(z), the delay as poles at 0."""
    denominator = np.append(model.denominator, np.zeros(samples))
    return TransferFunction(model.numerator.tolist(), denominator.tolist())


def altered_plant(model: TransferFunction, alteration: Alteration) -> TransferFunction:
    """The altered G(z); the same numbers where nothing but a whole delay is asked for.

    Raises ParameterError for a pole on the negative real axis, which no G(s) of this order has,
    and for a numerator that is not that of a delay by whole samples.
    """
    whole = int(alteration.lag + WHOLE)
    part = max(alteration.lag - whole, 0.0)
    if alteration.frequency == 1.0 and alteration.damping == 1.0 and part <= WHOLE:
        return delayed(model, whole)
    inner, delay = _without_delay(model)
    poles = _continuous_poles(inner)
    numerator = np.linalg.solve(_Sampled(poles).from_numerator(), inner.numerator[1:])
    poles = _damped(poles, alteration.damping) * alteration.frequency
    integrators = np.count_nonzero(poles == 0.0)
    powers = np.arange(1, len(poles) + 1) - integrators
    sampled = _Sampled(poles)
    numerator *= alteration.frequency**powers
    b, a = sampled.from_numerator(1.0 - part) @ numerator, sampled.denominator
    if part > WHOLE:
        # What was commanded a sample before acts for the first part of this one.
        b = np.append(b, 0.0) + np.append(0.0, sampled.from_numerator(part, 1.0 - part) @ numerator)
        a = np.append(a, 0.0)
    return delayed(TransferFunction(b.tolist(), a.tolist()), delay + whole)


class _Sampled:
    """G(s) = (c_0 s^(n-1) + ... + c_(n-1)) / D(s) under a zero-order hold, in samples.

    Observer form: x' = A x + c u, y = x_0.
    """

    def __init__(self, poles: Roots) -> None:
        # Takes as long to load as all else that a plant needs, and few plants need it.
        from scipy.linalg import expm, toeplitz
        self._expm = expm
        n = len(poles)
        self._a = np.zeros((n, n))
        self._a[:, 0] = -np.real(np.poly(poles))[1:]
        self._a[:-1, 1:] = np.eye(n - 1)
        self.denominator: Array = np.real(np.poly(np.exp(poles)))
        transition = expm(self._a)
        rows = [np.eye(n)[0]]
        for _ in range(n - 1):
            rows.append(rows[-1] @ transition)
        # Impulse response times denominator is the numerator.
        self._to_numerator = toeplitz(self.denominator[:n], np.eye(n)[0]) @ np.array(rows)

    def from_numerator(self, held: float = 1.0, after: float = 0.0) -> Array:
        """Matrix (n, n) from c to the numerator of G(z) for a u that acts over a share of a sample.

        held: that share, `after` it passes until the sample ends.
        """
        n = len(self._a)
        block = np.zeros((2 * n, 2 * n))
        block[:n, :n], block[:n, n:] = self._a, np.eye(n)
        effect = self._expm(block * held)[:n, n:]
        return np.asarray(self._to_numerator @ self._expm(self._a * after) @ effect)


def _without_delay(model: TransferFunction) -> tuple[TransferFunction, int]:
    """G(z) without its poles at 0, and their number."""
    delay = len(model.denominator) - 1 - int(np.flatnonzero(model.denominator)[-1])
    denominator = model.denominator[: len(model.denominator) - delay]
    numerator = model.numerator[model.delay:]
    if len(numerator) >= len(denominator):
        raise ParameterError(
            'plant.denominator', model.denominator.tolist(),
            f'has {delay} poles at 0 that are no delay by whole samples, which truth.scale_* and '
            'truth.extra_lag cannot alter', CURE,
        )
    return TransferFunction(numerator.tolist(), denominator.tolist()), delay


def _continuous_poles(model: TransferFunction) -> Roots:
    poles = model.poles
    negative = (poles.real < 0.0) & (np.abs(poles.imag) <= NEAR * np.abs(poles))
    if negative.any():
        raise ParameterError(
            'plant.denominator', model.denominator.tolist(),
            f'has the pole {float(poles[negative][0].real):.6g}: no continuous plant has poles on '
            'the negative real axis, so that truth.scale_* and truth.extra_lag cannot alter it',
            CURE,
        )
    return np.where(np.abs(poles - 1.0) < NEAR, 0.0, np.log(poles))


def _damped(poles: Roots, factor: float) -> Roots:
    altered: list[complex] = []
    for pole in poles:
        if pole.imag == 0.0:
            altered.append(pole)
        elif pole.imag > 0.0:
            frequency = abs(pole)
            ratio = -factor * pole.real / frequency
            root = np.sqrt(complex(ratio**2 - 1.0))
            altered += [frequency * (-ratio + root), frequency * (-ratio - root)]
    return np.array(altered, dtype=np.complex128)
