"""Models of one structure, their fit to a record, and how well the record determines G.

    G = z^-(1+delay) B / A,   xi = (B, a) with a vague prior;   m is held at 1, B has the gain

The Gauss-Newton steps of the loop fit them to a record that is centred and scaled first, so that
neither offsets nor units cost precision.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import inf, log, nan, sqrt
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import STEPS, TIGHT, Problem
from backlash_ros.core.estimation.posterior import Prior, WindowFit
from backlash_ros.core.judgement.deviations import covariance_of, effective
from backlash_ros.core.plant import numerics
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import is_stable, lfilter, padded, shifted
from backlash_ros.core.plant.transfer_function import Array

VAGUE = 1e3  # prior standard deviation of a coefficient, in scaled units
GRID: Array = np.pi * (np.arange(40) + 0.5) / 40  # frequencies [rad/sample]
SILENT = 0.1  # relative std of G, or difference of two models, beyond which G is unknown


@dataclass(unsafe_hash=True)
class Structure:
    """A family of plants. order: poles, of which one is at 1 if `integrator`. delay: samples from v
    to y, less one. taps: coefficients of B; 0 for as many as poles, but at least one.

    count: coefficients of G to fit. states: size of the state before a record. unknowns: all that
    is fitted, with gap, start, offset and state. leaks: as in Family; no prior has a scale here.
    """

    order: int
    delay: int
    integrator: bool
    taps: int = 0

    def __post_init__(self) -> None:
        self.free_poles = self.order - self.integrator
        self.numerator_taps = self.taps or max(self.order, 1)
        self.states = max(self.order, self.numerator_taps - 1)
        self.count = self.leaks = self.numerator_taps + self.free_poles
        self.unknowns = self.count + self.states + 3

    def at(self, xi: list[float]) -> tuple[list[float], list[float]]:
        """B and A, padded to one length; A is nan if a free pole lies outside the unit circle."""
        values = [VAGUE * x for x in xi]
        b, a = values[:self.numerator_taps], [1.0, *values[self.numerator_taps:]]
        if not is_stable(a):
            a = [nan] * len(a)
        if self.integrator:
            a = [one - before for one, before in zip([*a, 0.0], [0.0, *a], strict=True)]
        return b + [0.0] * (self.states + 1 - len(b)), a + [0.0] * (self.states + 1 - len(a))

    def slopes(self, _: list[float]) -> tuple[Array, Array]:
        """Derivatives of B and A with respect to each of xi, the same for every xi."""
        taps, poles = self.numerator_taps, self.free_poles
        of_b, of_a = np.zeros((2, self.count, self.states + 1))
        of_b[:taps, :taps] = VAGUE * np.eye(taps)
        of_a[taps:, 1:poles + 1] = VAGUE * np.eye(poles)
        if self.integrator:
            of_a[taps:, 2:poles + 2] -= VAGUE * np.eye(poles)
        return of_b, of_a

    def xi(self, numerator: Array, a: Array) -> Array:
        """xi from B, padded with zeros, and the free coefficients of A after the leading 1."""
        return np.append(padded(numerator, self.numerator_taps), a) / VAGUE


class Units(NamedTuple):
    """Offset and scale of v and of y, by which a record is centred and scaled."""

    v: float = 0.0
    v_size: float = 1.0
    y: float = 0.0
    y_size: float = 1.0


@dataclass(frozen=True)
class Samples:
    """A record (N,), centred and scaled, y nan where lost; y is fitted over [first, last).
    step: quantization step of y if rounding dominates the residual, so that equal readings share
    one error; else 0. drifts: whether u has a steady drift."""

    v: Array
    y: Array
    first: int
    last: int
    step: float
    units: Units
    drifts: bool = False

    @property
    def fitted_y(self) -> Array:
        return self.y[self.first:self.last]

    def problem(self, structure: Structure) -> Problem:
        begin, y = self.first - 1 - structure.delay, self.fitted_y
        prior = Prior(TIGHT * np.eye(1, 3 + structure.count), np.full(1, TIGHT))  # B has the gain
        return Problem(structure, self.v[begin:begin + len(y)], y, 1e-12, prior,
                       self.step, int(self.drifts))


@dataclass(eq=False)
class Model:
    """A structure and its fit, in scaled units. Models compare by their sums of squares.

    numerator: B. denominator: A with the integrator; a: its free coefficients after the leading 1.
    run: simulated y, and the play output that acts on it, at every sample. left: the residual where
    y is known (R,); squares: the sum of its squares, inf if that is not finite; rms: its rms.
    """

    structure: Structure
    problem: Problem
    fit: WindowFit

    def __post_init__(self) -> None:
        taps, self.gap = self.structure.numerator_taps, self.fit.gap
        b, a = self.structure.at(self.fit.xi)
        self.numerator = np.array(b[:taps])
        self.denominator = np.array(a[:self.structure.order + 1])
        self.a: Array = VAGUE * self.fit.theta[3 + taps:]
        self.run = self.problem.at(self.fit)
        self.left: Array = self.run.error[self.problem.known]
        squares = float(self.left @ self.left)
        self.squares = squares if np.isfinite(squares) else inf
        self.rms = sqrt(self.squares / max(len(self.left), 1))

    def __lt__(self, other: Model) -> bool:
        return self.squares < other.squares

    def behind(self, best: Model, rows: float) -> float:
        """Twice the log-likelihood by which it is behind `best`, of `rows` independent readings."""
        return rows * log(max(self.squares, 1e-300) / max(best.squares, 1e-300))

    def begin(self, gap: float | None = None, p0: float | None = None) -> WindowFit:
        """Initial values for another fit: these, with the gap and p0 if given, and a zero state."""
        theta = self.fit.theta.copy()
        theta[2] = self.gap if gap is None else gap
        return WindowFit(np.zeros(1), self.fit.p0 if p0 is None else p0, theta,
                         self.fit.noise_std, self.fit.knots, self.fit.walk_std)

    def begin_with_pole(self, pole: float, structure: Structure) -> WindowFit:
        """Initial values for `structure`, one order higher: a zero cancels the additional pole."""
        b, a = (np.asarray(np.convolve(one, (1.0, -pole)), dtype=float)
                for one in (self.numerator, np.append(1.0, self.a)))
        return replace(self.begin(), theta=np.append(self.fit.theta[:3], structure.xi(b, a[1:])))


def fitted(
    samples: Samples, structure: Structure, *begins: WindowFit, steps: int = STEPS,
    least_gain: float = 0.0,
) -> Model:
    """The best of the fits from these initial values. least_gain: a step that raises the
    log-likelihood by less is the last."""
    found = []
    for begin in begins:
        problem = samples.problem(structure)
        # Readings are values here, not intervals, and never without noise.
        fit = replace(begin, step=0.0, noise_std=max(begin.noise_std, 1e-12),
                      walk_std=VAGUE * samples.drifts)
        with suppress(np.linalg.LinAlgError):  # without a finite posterior it stays as it began
            fit = problem.fitted(fit, steps, least_gain)
        found.append(Model(structure, problem, fit))
    return min(found)


def first_model(samples: Samples, structure: Structure, gap: float, p0: float) -> Model:
    """The best model by Steiglitz-McBride iteration, for a play of this gap that begins at p0."""
    problem, taps, count = samples.problem(structure), structure.numerator_taps, \
        len(samples.fitted_y)
    known = problem.known
    slow = [np.ones(count), np.linspace(1.0, 0.0, count)][:1 + samples.drifts]
    moves = np.vstack([play(problem.v, gap, p0), *slow])

    def follows(a: Array) -> Array:
        # Only the free poles multiply y; an integrator divides all that y follows.
        whole = np.asarray(np.convolve(a, (1.0, -1.0))) if structure.integrator else a
        moved, *constant = lfilter([1.0], whole, moves)
        of_state = shifted(lfilter([1.0], whole, np.eye(1, count)[0]), structure.states)
        return np.vstack([shifted(moved, taps), *constant, of_state])

    y, found = np.interp(np.arange(count), np.flatnonzero(known), problem.y[known]), []
    for a, weights in numerics.steiglitz_mcbride(y, follows, structure.free_poles, known):
        b, gain = weights[:taps], float(weights[:taps].sum())
        offset, *drift = weights[taps:taps + len(slow)] / gain if gain else np.zeros(len(slow))
        theta = np.concatenate([[1.0, -offset, gap], structure.xi(b, a[1:])])
        found.append(Model(structure, problem, WindowFit(
            weights[taps + len(slow):], p0, theta, 1.0, np.array(drift), VAGUE * samples.drifts)))
    return min(found)


class Response(NamedTuple):
    """Frequency response of m G without its delay. covariance: of xi (K, K). unit: scale of y over
    that of v."""

    structure: Structure
    xi: list[float]
    covariance: Array
    unit: float

    def at(self, frequencies: Array) -> NDArray[np.complex128]:
        """Complex response at frequencies [rad/sample]."""
        back = np.exp(-1j * np.asarray(frequencies))
        b, a = self.structure.at(self.xi)
        return np.asarray(self.unit * back * polyval(back, b) / polyval(back, a))

    def std(self, frequencies: Array) -> Array:
        """Relative standard deviation at frequencies [rad/sample], shape (N,)."""
        z = np.exp(1j * np.maximum(frequencies, 1e-6))  # an integrator cancels, but not at 0
        return numerics.response_std(self.structure, self.xi, self.covariance, z)

    @property
    def known_up_to(self) -> float:
        """Highest frequency of GRID [rad/sample] at which G is known; the lowest if at none."""
        known = np.flatnonzero(self.std(GRID) <= SILENT)
        return float(GRID[known[-1]]) if len(known) else float(GRID[0])


def response_of(found: Model, covariance: Array | None = None, unit: float = 1.0) -> Response:
    """Response of a model with this covariance of theta. unit: scale of y over that of v."""
    of_xi = np.zeros((found.structure.count,) * 2) if covariance is None else covariance[3:, 3:]
    return Response(found.structure, found.fit.xi, of_xi, unit)


def least_response(best: Model, rivals: Sequence[Model] = ()) -> Model:
    """Choose between the best model and rivals that fit as well with another delay.

    If v has little power at high frequencies, noise determines zeros and delay of G there, and a
    fast controller would act on it. So of all models within two standard deviations of each fit,
    take the one with the least |G|^2 where G is unknown, or else where the delays disagree: sampled
    plants behind a hold have little gain there.
    """
    if best.structure.numerator_taps < 2:
        return best  # |B| is the same at every frequency
    own = response_of(best, covariance_of(best.problem, best.fit))
    silent = own.known_up_to < GRID
    if not silent.any():
        for one in rivals:
            later = np.exp(-1j * GRID * (one.structure.delay - best.structure.delay))
            other = response_of(one)
            silent |= np.abs(other.at(GRID) * later / own.at(GRID) - 1.0) > SILENT
    if not silent.any():
        return best
    smooth = [_smoothed(one, GRID[silent], best.squares / effective(best.left))
              for one in (best, *rivals)]
    return min(smooth, key=lambda one: float(
        np.sum(np.abs(response_of(one).at(GRID[silent])) ** 2)))


def _smoothed(found: Model, silent: Array, noise_variance: float) -> Model:
    """The model with the heaviest penalty on |G| at `silent` within two standard deviations."""
    covariance, taps = covariance_of(found.problem, found.fit), found.structure.numerator_taps
    # Times B they are G at these frequencies but for its phase, real and imaginary parts.
    back = np.exp(-1j * silent)
    of_b = back[:, None] ** np.arange(taps) / np.abs(polyval(back, found.denominator))[:, None]
    rows = np.zeros((2 * len(silent), len(covariance)))
    rows[:, 3:3 + taps] = VAGUE * np.vstack([of_b.real, of_b.imag])
    pull = covariance @ rows.T @ rows
    for weight in 1e6 / max(float(np.trace(pull)), 1e-300) * 0.0625 ** np.arange(12.0):
        theta = np.linalg.solve(np.eye(len(pull)) + weight * pull, found.fit.theta)
        theta[2] = theta[2] if theta[2] > 0.0 else found.gap  # linear steps may leave the range
        fit = replace(found.fit, theta=theta)
        if not np.isfinite(found.structure.at(fit.xi)[1]).all():
            continue  # a pole has left the unit circle
        smooth = Model(found.structure, found.problem, found.problem.begun(fit))
        if smooth.squares <= found.squares + 4.0 * noise_variance:
            return smooth
    return found
