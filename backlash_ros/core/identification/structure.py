"""All plants of one structure, and their fit to a record by the Gauss-Newton steps of the loop.

    G = z^-(1+delay) B / A,   xi = (B, a) without any prior worth mentioning;   m = 1 is in B

A record is centred and scaled first, so that neither an offset nor a unit takes digits. First
values come from Steiglitz and McBride: least squares in A and B with everything filtered by 1/A of
the step before, which noise of y does not bias as it does a plain ARX fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import STEPS, Problem
from backlash_ros.core.estimation.plant_family import padded, state_columns
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]

VAGUE = 1e3  # prior deviation of a coefficient, in scaled units
TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class Structure:
    """Number of poles, of which one may be an integrator; samples of v before it acts, less one.

    taps: coefficients of B; where 0 as many as poles, one of G that is a gain (order 0).
    """

    order: int
    delay: int
    integrator: bool
    taps: int = 0

    @property
    def free_poles(self) -> int:
        """Poles that are fitted."""
        return self.order - self.integrator

    @property
    def numerator_taps(self) -> int:
        """Coefficients of B."""
        return self.taps or max(self.order, 1)

    @property
    def unknowns(self) -> int:
        """Numbers that are fitted, with the gap, the start, the offset and the state."""
        return self.count + self.states + 3

    @property
    def states(self) -> int:
        """Numbers of the state before a record."""
        return self._length - 1

    @property
    def _length(self) -> int:
        return max(self.order + 1, self.numerator_taps)

    # --- as the family of a fit --------------------------------------------------------------

    @property
    def count(self) -> int:
        """Coefficients that are fitted."""
        return self.numerator_taps + self.free_poles

    @property
    def leaks(self) -> int:
        """All of them have priors of their own."""
        return self.count

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        """B and A of one length; no numbers where a pole lies outside of the unit circle."""
        values = [VAGUE * x for x in xi]
        b, a = values[:self.numerator_taps], [1.0, *values[self.numerator_taps:]]
        if not _stable(a):
            a = [nan] * len(a)
        if self.integrator:
            a = [one - before for one, before in zip([*a, 0.0], [0.0, *a], strict=True)]
        return (b + [0.0] * (self._length - len(b)), a + [0.0] * (self._length - len(a)))

    def slopes(self, _: list[float]) -> tuple[Array, Array]:
        """Derivatives of B and A by each of xi, the same everywhere."""
        taps = self.numerator_taps
        of_b = VAGUE * np.eye(self.count, self._length)
        of_b[taps:] = 0.0
        of_a = np.zeros((self.count, self._length))
        for j in range(self.free_poles):
            of_a[taps + j, j + 1] = VAGUE
            if self.integrator:
                of_a[taps + j, j + 2] = -VAGUE
        return of_b, of_a

    def xi(self, numerator: Array, a: Array) -> Array:
        """xi of B and the free coefficients of A behind the leading 1; missing taps are 0."""
        taps = np.zeros(self.numerator_taps)
        taps[:len(numerator)] = numerator[:len(taps)]
        return np.append(taps, a) / VAGUE


def _stable(a: list[float]) -> bool:
    """Whether no root of 1 + a1 z^-1 + ... lies outside of the unit circle, nor on it.

    By the reflection coefficients of the Levinson recursion backwards.
    """
    while len(a) > 1:
        k = a[-1]
        if not abs(k) < 1.0:
            return False
        a = [(x - k * y) / (1.0 - k * k) for x, y in zip(a[:-1], a[:0:-1], strict=True)]
    return True


@dataclass(frozen=True)
class Samples:
    """A record (N,), centred and scaled, y nan where lost; [first, last): the y that are fitted.

    v before `first` covers the longest delay. step: of the readings where rounding is most of what
    a fit leaves, so that repeated ones repeat one error; else 0.
    """

    v: Array
    y: Array
    first: int
    last: int
    step: float

    @property
    def count(self) -> int:
        """Of the y that are fitted."""
        return self.last - self.first

    def fitted_y(self) -> Array:
        """The y that are fitted (M,)."""
        return self.y[self.first:self.last]

    def problem(self, structure: Structure) -> Problem:
        """The fit of a structure."""
        held = 1e6  # weight of m = 1, which is in B
        begin = self.first - 1 - structure.delay
        prior = Prior(held * np.eye(1, 3 + structure.count), np.full(1, held))
        return Problem(structure, self.v[begin:begin + self.count], self.fitted_y(), 1e-12,
                       prior, step=self.step)


@dataclass(frozen=True)
class Model:
    """A structure with the values that fit best, all in scaled units."""

    structure: Structure
    problem: Problem
    fit: WindowFit

    @cached_property
    def simulated(self) -> Array:
        """y of the model at every sample (M,)."""
        return self.problem.at(self.fit).y

    @cached_property
    def residual(self) -> Array:
        """y less what is simulated (M,), nan where lost."""
        return np.asarray(self.problem.residual(self.fit))

    @cached_property
    def left(self) -> Array:
        """The residual where y is known (R,)."""
        return np.asarray(self.residual[self.problem.known])

    @property
    def squares(self) -> float:
        """Of the residual; inf where they are no number."""
        squares = float(self.left @ self.left)
        return squares if np.isfinite(squares) else inf

    @property
    def rms(self) -> float:
        """Of the residual."""
        return sqrt(self.squares / max(len(self.left), 1))

    @property
    def gap(self) -> float:
        """c_r - c_l."""
        return self.fit.gap

    @cached_property
    def p(self) -> Array:
        """Play output as it acts on each y (M,)."""
        return self.problem.at(self.fit).p

    @property
    def numerator(self) -> Array:
        """B."""
        return np.array(self.structure.at(self.fit.xi)[0][:self.structure.numerator_taps])

    @property
    def a(self) -> Array:
        """Free coefficients of A behind the leading 1."""
        return np.asarray(VAGUE * self.fit.theta[3 + self.structure.numerator_taps:])

    @property
    def denominator(self) -> Array:
        """A, with the integrator."""
        return np.array(self.structure.at(self.fit.xi)[1][:self.structure.order + 1])


def fitted(
    samples: Samples, structure: Structure, begin: WindowFit, steps: int = STEPS,
) -> Model:
    """The best values nearest to some."""
    problem = samples.problem(structure)
    # As much noise as there is motion hides nothing from the first step.
    begin = replace(begin, step=0.0, noise_std=max(begin.noise_std, 1e-12))
    with suppress(np.linalg.LinAlgError):  # what has no finite posterior stays as it began
        begin = problem.fitted(begin, steps)
    return Model(structure, problem, begin)


def moved_to(
    structure: Structure, like: Model, gap: float | None = None, p0: float | None = None,
    factor: Sequence[float] = (1.0,),
) -> WindowFit:
    """What a fit of a structure may begin with, from a model.

    factor: (1, -pole) for a structure with a pole more, which a zero cancels.
    """
    fit, (m, offset, width) = like.fit, like.fit.theta[:3].tolist()
    b, a = (np.asarray(np.convolve(one, factor), dtype=float)
            for one in (like.numerator, np.append(1.0, like.a)))
    begin = np.append([m, offset, width if gap is None else gap], structure.xi(b, a[1:]))
    return WindowFit(np.zeros(1), fit.p0 if p0 is None else p0, begin, fit.noise_std)


def first_model(
    samples: Samples, structure: Structure, gap: float, p0: float,
    filters: Sequence[float] = (0.6, 0.95),
) -> Model:
    """The best model by Steiglitz and McBride for a play of this gap and beginning.

    filters: poles of the first filters.
    """
    inside = 0.999  # where poles outside of the unit circle are put
    problem, count = samples.problem(structure), samples.count
    taps, poles, known = structure.numerator_taps, structure.free_poles, problem.known
    signals = np.zeros((3, count))
    signals[0] = play(problem.v, gap, p0)
    signals[1] = np.interp(np.arange(count), np.flatnonzero(known), problem.y[known])
    signals[2] = 1.0
    columns = np.zeros((taps + poles + structure.states + 2, count))
    found = []
    for pole in filters if poles else filters[:1]:
        a: Array = np.atleast_1d(np.poly([pole] * poles))
        for _ in range(3 if poles else 1):
            # A y over A: with an integrator in both, 1 - 1/z cancels.
            columns[-1] = back = lfilter([1.0], a, signals[1])
            whole = np.asarray(np.convolve(a, (1.0, -1.0))) if structure.integrator else a
            moved, constant = lfilter([1.0], whole, signals[::2])
            for i in range(taps):
                columns[i, i:] = moved[:count - i]
            for j in range(poles):
                columns[taps + j, j + 1:] = -back[:count - j - 1]
            columns[taps + poles] = constant
            columns[taps + poles + 1:-1] = state_columns(
                padded(whole, structure.states + 1).tolist(), count).T
            r = np.asarray(np.linalg.qr(columns[:, known].T, mode='r'))
            solution = np.linalg.lstsq(r[:, :-1], r[:, -1], rcond=1e-13)[0]
            a = np.append(1.0, solution[taps:taps + poles])
            roots = np.roots(a)
            size = np.abs(roots)
            if size.max(initial=0.0) > inside:
                a = np.real(np.poly(roots * np.minimum(inside / np.maximum(size, inside), 1.0)))
        b, gain = solution[:taps], float(solution[:taps].sum())
        offset = -float(solution[taps + poles]) / gain if gain else 0.0
        theta = np.concatenate([[1.0, offset, gap], structure.xi(b, a[1:])])
        fit = WindowFit(solution[len(solution) - structure.states:], p0, theta, 1.0)
        found.append(Model(structure, problem, fit))
    return min(found, key=lambda model: model.squares)
