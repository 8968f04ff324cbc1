"""Output error: the simulated y of B(z)/A(z), fitted to the measured one for one structure.

With the play output p, u = m (p - c_r) and y = G u, all that is linear in

    A y = z^-(1+d) B p + e + X,    e = -c_r B(1),  X: the state at the start

is solved for exactly (variable projection); A, the gap and the start of p take Levenberg-Marquardt
steps on what is left. m is in B: it cannot be told from the gain of G.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from backlash_ros.core.identification.play_record import PlayOutput, PlayRecord
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

TOLERANCE = 1e-7  # relative fall of the squares below which a fit is done
# Of Levenberg and Marquardt: at first, times after a step down and one up, where a fit gives up.
FIRST_DAMPING, LESS, MORE, MOST_DAMPING = 1e-3, 0.2, 5.0, 1e8
SINGULAR = 1e-13  # of columns of length 1


class Structure(NamedTuple):
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
    def state_terms(self) -> int:
        """Coefficients of X: the state at the start, and what p was before it."""
        return max(self.order, self.numerator_taps - 1)

    @property
    def unknowns(self) -> int:
        """Numbers that are fitted, with the gap, the start, e and the state at the start."""
        return self.free_poles + self.numerator_taps + self.state_terms + 3


class Samples:
    """v (N,) and y (N,), nan where lost, and the part of y that is fitted.

    first: index of the first fitted y; v before it covers the longest delay. weight: rows that
    count, all known ones by default.
    """

    def __init__(self, v: Array, y: Array, first: int, last: int | None = None,
                 play: PlayRecord | None = None) -> None:
        self.play = PlayRecord(v) if play is None else play
        self.v, self.whole_y = v, y
        self.first, self.last = first, len(v) if last is None else last
        self.y = y[self.first:self.last]
        self.known = np.flatnonzero(np.isfinite(self.y))
        self.target = self.y[self.known]
        self.count = self.last - self.first
        self.complete = len(self.known) == self.count
        self.centre = float(v.mean())

    def part(self, first: int, last: int) -> Samples:
        """The same record, with the y from first to last only."""
        return Samples(self.v, self.whole_y, first, last, self.play)

    def without(self, rows: NDArray[np.bool_]) -> Samples:
        """The same without the y of these rows (of the fitted ones)."""
        y = self.whole_y.copy()
        y[self.first:self.last][rows] = np.nan
        return Samples(self.v, y, self.first, self.last, self.play)

    def delayed(self, signal: Array, delay: int) -> Array:
        """What of a signal (N,) of v acts on each fitted y, one sample and the delay later."""
        begin = self.first - 1 - delay
        return signal[begin:begin + self.count]


class Point(NamedTuple):
    """What is not linear: free coefficients of A (after the leading 1), gap, start of p."""

    a: Array
    gap: float
    start: float


@dataclass(frozen=True)
class Fit:
    """A fit of one structure. linear: B, e, X. simulated: y (M,) of the model at every sample.

    squares: of the residual over the known samples.
    """

    structure: Structure
    point: Point
    linear: Array
    simulated: Array
    play: PlayOutput
    centre: float
    squares: float
    rows: int

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(self.squares / max(self.rows, 1)))

    @property
    def denominator(self) -> Array:
        """A, descending powers of z, without the delay."""
        return full_denominator(self.structure, self.point.a)

    @property
    def numerator(self) -> Array:
        """B of m G: taps coefficients, the first of them delay + 1 samples after v."""
        return self.linear[:self.structure.numerator_taps]

    @property
    def c_r(self) -> float:
        """Right crossing [v]; nan where G has no gain at rest."""
        total = float(self.numerator.sum())
        offset = float(self.linear[self.structure.numerator_taps])
        return self.centre - offset / total if total != 0.0 else nan


def full_denominator(structure: Structure, a: Array) -> Array:
    """A with its leading 1 and the integrator."""
    free = np.append(1.0, a)
    return np.convolve(free, (1.0, -1.0)) if structure.integrator else free


class Linear(NamedTuple):
    """The exact solution for a given A and p.

    basis: orthonormal, over the known rows and those of a penalty; residual and squares likewise.
    """

    solution: Array
    basis: Array
    residual: Array
    simulated: Array
    squares: float


def linear_columns(samples: Samples, structure: Structure, a: Array, p: Array) -> Array:
    """What multiplies B, e and X in the simulated y, shape (M, L)."""
    count, taps = samples.count, structure.numerator_taps
    inputs = np.zeros((2, count))
    inputs[0] = samples.delayed(p, structure.delay) - samples.centre
    inputs[1, 0] = 1.0
    moved, impulse = lfilter([1.0], full_denominator(structure, a), inputs)
    columns = np.zeros((count, taps + 1 + structure.state_terms), order='F')
    for i in range(taps):
        columns[i:, i] = moved[:count - i]
    columns[:, taps] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        columns[i:, taps + 1 + i] = impulse[:count - i]
    return columns


def solve_linear(
    samples: Samples, structure: Structure, a: Array, p: Array, penalty: Array | None = None,
) -> Linear:
    """All that is linear, for free coefficients a of A and a play output p (N,).

    penalty: rows (K, taps) whose product with B is to be small as well.
    """
    columns = linear_columns(samples, structure, a, p)
    known = columns if samples.complete else columns[samples.known]
    target = samples.target
    if penalty is not None:
        more = np.zeros((len(penalty), columns.shape[1]))
        more[:, :structure.numerator_taps] = penalty
        known, target = np.vstack([known, more]), np.append(target, np.zeros(len(penalty)))
    scale = np.sqrt(np.einsum('ij,ij->j', known, known))
    scale[scale == 0.0] = 1.0
    basis, upper = np.linalg.qr(known / scale)
    along = basis.T @ target
    if np.abs(np.diag(upper)).min() > SINGULAR:
        solution = solve_triangular(upper, along, check_finite=False) / scale
    else:
        solution = np.linalg.lstsq(upper, along, rcond=SINGULAR)[0] / scale
    residual = target - basis @ along
    squares = float(residual @ residual)
    return Linear(solution, basis, residual, columns @ solution,
                   squares if np.isfinite(squares) else inf)


def squares_of(samples: Samples, structure: Structure, point: Point) -> float:
    """What is left over at a point, with all that is linear at its best."""
    p = samples.play.output(point.gap, point.start).p
    return solve_linear(samples, structure, point.a, p).squares


def slopes(
    samples: Samples, structure: Structure, a: Array, play: PlayOutput, numerator: Array,
    simulated: Array,
) -> Array:
    """Derivatives of the simulated y (M, K) by a, the gap and the start."""
    count = samples.count
    columns = np.zeros((count, len(a) + 2), order='F')
    if len(a):
        back = -lfilter([1.0], np.append(1.0, a), simulated)
        for j in range(len(a)):
            columns[j + 1:, j] = back[:count - j - 1]
    inputs = np.vstack([
        samples.delayed(play.by_gap, structure.delay),
        samples.delayed(play.by_start, structure.delay),
    ])
    columns[:, len(a):] = lfilter(numerator, full_denominator(structure, a), inputs).T
    return columns


def fit(
    samples: Samples, structure: Structure, start: Point, gap_free: bool = True,
    iterations: int = 40, penalty: Array | None = None,
) -> Fit:
    """The least squares nearest to a start. gap_free: whether the gap moves as well.

    penalty: as of `solve_linear`; the squares of the fit are without it.
    """
    top = samples.play.swing
    v0 = float(samples.v[0])

    def evaluate(point: Point) -> tuple[PlayOutput, Linear]:
        play = samples.play.output(point.gap, point.start)
        return play, solve_linear(samples, structure, point.a, play.p, penalty)

    point = start
    play, linear = evaluate(point)
    damping = FIRST_DAMPING
    for _ in range(iterations):
        columns = slopes(
            samples, structure, point.a, play, linear.solution[:structure.numerator_taps],
            linear.simulated,
        )
        if not gap_free:
            columns = np.delete(columns, len(point.a), axis=1)
        if not samples.complete:
            columns = columns[samples.known]
        if penalty is not None:
            columns = np.vstack([columns, np.zeros((len(penalty), columns.shape[1]))])
        free = columns - linear.basis @ (linear.basis.T @ columns)
        # The normal equations would square a condition that is bad already near z = 1.
        scale = np.sqrt(np.einsum('ij,ij->j', free, free))
        scale[scale == 0.0] = 1.0
        basis, upper = np.linalg.qr(free / scale)
        downhill = np.append(basis.T @ linear.residual, np.zeros(len(scale)))
        before = linear.squares
        while damping < MOST_DAMPING:
            damped = np.vstack([upper, np.sqrt(damping) * np.eye(len(scale))])
            step = np.linalg.lstsq(damped, downhill, rcond=None)[0] / scale
            new = _moved(point, np.asarray(step, dtype=np.float64), gap_free, top, v0)
            if largest_pole(new.a) <= 1.0:
                new_play, new_linear = evaluate(new)
                if new_linear.squares < linear.squares:
                    point, play, linear = new, new_play, new_linear
                    damping = max(damping * LESS, 1e-12)
                    break
            damping *= MORE
        if not linear.squares < before * (1.0 - TOLERANCE):
            break
    rows = len(samples.known)
    residual = linear.residual[:rows]
    return Fit(
        structure, point, linear.solution, linear.simulated, play, samples.centre,
        float(residual @ residual), rows,
    )


def _moved(point: Point, step: Array, gap_free: bool, top: float, v0: float) -> Point:
    count = len(point.a)
    a = point.a + step[:count]
    gap = min(max(point.gap + float(step[count]), 0.0), top) if gap_free else point.gap
    start = min(max(point.start + float(step[-1]), v0), v0 + gap)
    return Point(a, gap, start)


def largest_pole(a: Array) -> float:
    """Magnitude of the largest root of z^n + a[0] z^(n-1) + ..., 0 for none; inf for no number."""
    if not np.isfinite(a).all():
        return inf
    if not len(a):
        return 0.0
    companion = np.diag(np.ones(len(a) - 1), -1)
    companion[0] = -a
    return float(np.abs(np.linalg.eigvals(companion)).max())
