"""Output error: the simulated y of B(z)/A(z), fitted to the measured one for one structure.

With the play output p, u = m (p - c_r) and y = G u, all that is linear in

    A y = z^-(1+d) B p + e + X,    e = -c_r B(1),  X: the state at the start

is solved for exactly (variable projection); A, the gap and the start of p take Levenberg-Marquardt
steps on what is left, by the triangle R of one QR of all columns. m is in B: it cannot be told from
the gain of G. A first A comes from Steiglitz and McBride: least squares in A and B with everything
filtered by 1/A of the step before, which noise of y does not bias as it does a plain ARX fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import ceil, inf, nan, sqrt
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from backlash_ros.core.estimation.play import LEFT, NEITHER, Sides, play, plays, reversals
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]
T = TypeVar('T', bound=np.generic)

TINY = float(np.finfo(float).tiny)
FILTERS = (0.6, 0.95)  # poles of the first filters of Steiglitz and McBride


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

    def denominator(self, a: Array) -> Array:
        """A with its leading 1 and the integrator."""
        free = np.append(1.0, a)
        return np.convolve(free, (1.0, -1.0)) if self.integrator else free


@dataclass(frozen=True)
class Samples:
    """v (N,) and y (N,), nan where lost, and the part of y (M,) that is fitted.

    first, last: of the fitted y; v before it covers the longest delay. most: rows that are fitted,
    about; of more readings, neighbours are averaged; 0: all. penalty: rows (K, taps) whose product
    with B is to be small as well. y is fitted without its middle: an offset takes no digits.
    """

    v: Array
    whole_y: Array
    first: int
    last: int
    most: int = 0
    penalty: Array | None = None

    @cached_property
    def y(self) -> Array:
        """The fitted y (M,)."""
        return self.whole_y[self.first:self.last]

    @property
    def count(self) -> int:
        """M."""
        return self.last - self.first

    @cached_property
    def middle(self) -> float:
        """Of all y that is known."""
        return float(np.nanmedian(self.whole_y))

    @cached_property
    def known(self) -> NDArray[np.intp]:
        """Indices of the fitted y that are known."""
        return np.flatnonzero(np.isfinite(self.y))

    @cached_property
    def target(self) -> Array:
        """What is fitted, shape (R,)."""
        return self.reduced(np.where(np.isfinite(self.y), self.y - self.middle, 0.0))

    @cached_property
    def _bins(self) -> tuple[NDArray[np.intp], Array]:
        """Where bins of neighbours begin, and the readings in each."""
        head = 30  # readings at the begin that are not averaged: they tell the state at the start
        each = ceil(max(self.count - head, 1) / self.most) if self.most else 1
        begins = np.append(np.arange(min(head, self.count)), np.arange(head, self.count, each))
        return begins, np.add.reduceat(np.isfinite(self.y).astype(float), begins)

    def reduced(self, signals: Array) -> Array:
        """The rows (..., R) that are fitted of signals (..., M); zeros for those of a penalty."""
        begins, readings = self._bins
        if len(begins) == self.count:
            rows = signals if len(self.known) == self.count else signals[..., self.known]
        else:
            known = signals if len(self.known) == self.count \
                else np.where(np.isfinite(self.y), signals, 0.0)
            read = readings > 0.0
            rows = np.add.reduceat(known, begins, axis=-1)[..., read] / np.sqrt(readings[read])
        if self.penalty is None:
            return rows
        return np.concatenate([rows, np.zeros((*rows.shape[:-1], len(self.penalty)))], axis=-1)

    def delayed(self, signal: NDArray[T], delay: int) -> NDArray[T]:
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

    p: play output (N,). squares: of the residual over the rows (R,) that were fitted.
    """

    samples: Samples
    structure: Structure
    point: Point
    linear: Array
    simulated: Array
    p: Array
    squares: float

    @property
    def rows(self) -> int:
        """Readings, or means of neighbours, that were fitted."""
        return len(self.samples.target)

    @property
    def rms(self) -> float:
        """Of the residual."""
        return sqrt(self.squares / max(self.rows, 1))

    @property
    def residual(self) -> Array:
        """y less what is simulated (M,), nan where lost."""
        return self.samples.y - self.simulated

    @property
    def denominator(self) -> Array:
        """A, descending powers of z, without the delay."""
        return self.structure.denominator(self.point.a)

    @property
    def numerator(self) -> Array:
        """B of m G: taps coefficients, the first of them delay + 1 samples after v."""
        return self.linear[:self.structure.numerator_taps]

    @property
    def offset(self) -> float:
        """e, with the middle of y."""
        e = float(self.linear[self.structure.numerator_taps])
        return e + self.samples.middle * float(self.denominator.sum())

    @property
    def c_r(self) -> float:
        """Right crossing [v]; nan where G has no gain at rest."""
        total = float(self.numerator.sum())
        return float(self.samples.v.mean()) - self.offset / total if total != 0.0 else nan

    @property
    def sides(self) -> Sides:
        """Side of the gap that was engaged last, (N,): p went its way, where the gap is 0 as well.

        NEITHER before the first: p is where it began.
        """
        way = np.sign(np.diff(self.p, prepend=self.point.start)).astype(np.int8)
        newest = np.maximum.accumulate(np.where(way != NEITHER, np.arange(len(way)), 0))
        return np.asarray(way[newest])

    @property
    def reversals(self) -> int:
        """How often the other side engaged."""
        return len(reversals(self.sides))


def triangle(rows: Array) -> Array:
    """R (P, P) of the QR of columns, given as rows (P, R)."""
    if len(rows) > rows.shape[1]:
        rows = np.pad(rows, ((0, 0), (0, len(rows) - rows.shape[1])))
    return np.triu(lapack.dgeqrf(rows.T)[0][:len(rows)])


def solved(r: Array) -> Array:
    """Least squares of the last column of a triangle by the others, the least if singular."""
    singular = 1e-13  # of columns of length 1
    upper, target = r[:-1, :-1], r[:-1, -1]
    if not np.isfinite(r).all():
        return np.full(len(target), nan)
    size = np.sqrt(np.einsum('ij,ij->j', upper, upper))
    size[size == 0.0] = 1.0
    upper = upper / size
    if len(upper) and np.abs(np.diag(upper)).min() > singular:
        return np.asarray(lapack.dtrtrs(upper, target)[0] / size)
    return np.asarray(np.linalg.lstsq(upper, target, rcond=singular)[0] / size)


def squares_left(r: Array) -> float:
    """What the columns of a triangle leave of the last one; inf where it is no number."""
    squares = float(r[-1, -1]) ** 2
    return squares if np.isfinite(squares) else inf


def linear_rows(samples: Samples, structure: Structure, a: Array, p: Array) -> Array:
    """What multiplies B, e and X in the simulated y, shape (L, M)."""
    count, taps = samples.count, structure.numerator_taps
    inputs = np.zeros((2, count))
    inputs[0] = samples.delayed(p, structure.delay) - samples.v.mean()
    inputs[1, 0] = 1.0
    moved, impulse = lfilter([1.0], structure.denominator(a), inputs)
    rows = np.zeros((taps + 1 + structure.state_terms, count))
    for i in range(taps):
        rows[i, i:] = moved[:count - i]
    rows[taps] = np.cumsum(impulse)
    for i in range(structure.state_terms):
        rows[taps + 1 + i, i:] = impulse[:count - i]
    return rows


def slope_rows(found: Fit) -> Array:
    """Derivatives of the simulated y by the free coefficients of A, gap and start, shape (K, M)."""
    samples, a, delay = found.samples, found.point.a, found.structure.delay
    rows = np.zeros((len(a) + 2, samples.count))
    if len(a):
        back = -lfilter([1.0], np.append(1.0, a), found.simulated - samples.middle)
        for j in range(len(a)):
            rows[j, j + 1:] = back[:samples.count - j - 1]
    sides = samples.delayed(found.sides, delay)
    rows[len(a):] = lfilter(
        found.numerator, found.denominator, np.stack([sides == LEFT, sides == NEITHER]) * 1.0)
    return rows


def evaluate(samples: Samples, structure: Structure, point: Point) -> tuple[Fit, Array]:
    """The fit with all that is linear at its best, and the rows of that, shape (L, R)."""
    p = play(samples.v, point.gap, point.start)
    rows = linear_rows(samples, structure, point.a, p)
    reduced = _with_penalty(samples, samples.reduced(rows))
    r = triangle(np.vstack([reduced, samples.target]))
    linear = solved(r)
    simulated = linear @ rows + samples.middle
    return Fit(samples, structure, point, linear, simulated, p, squares_left(r)), reduced


def _with_penalty(samples: Samples, rows: Array) -> Array:
    if samples.penalty is not None:
        count, taps = samples.penalty.shape
        rows[:taps, -count:] = samples.penalty.T
    return rows


def squares_of(samples: Samples, structure: Structure, a: Array, p: Array) -> float:
    """What is left over for a and p (N,), with all that is linear at its best."""
    rows = samples.reduced(linear_rows(samples, structure, a, p))
    return squares_left(triangle(np.vstack([rows, samples.target])))


def best_start(
    samples: Samples, structure: Structure, models: Sequence[Array], gap: float,
    shares: Sequence[float], *more: float,
) -> Point:
    """Of models and starts of p the pair that leaves least over, without any step.

    shares: places in the gap at which p may begin; more: values of p.
    """
    starts = [*more, *(float(samples.v[0]) + share * gap for share in shares)]
    played = plays(samples.v, np.full(len(starts), gap), np.array(starts))
    _, i, j = min(
        (squares_of(samples, structure, a, p), i, j)
        for i, a in enumerate(models) for j, p in enumerate(played)
    )
    return Point(models[i], gap, starts[j])


def fit(
    samples: Samples, structure: Structure, start: Point, steps: int = 40, gap_free: bool = True,
) -> Fit:
    """The least squares nearest to a start. gap_free: whether the gap moves as well."""
    best, rows = evaluate(samples, structure, start)
    damping = 1e-3
    for _ in range(steps):
        free = samples.reduced(slope_rows(best))
        if not gap_free:
            free = np.delete(free, -2, axis=0)
        r = triangle(np.vstack([rows, free, samples.target]))[len(rows):, len(rows):]
        upper, before = r[:-1, :-1], best.squares
        # What the linear unknowns leave of these columns.
        size = np.sqrt(np.einsum('ij,ij->j', upper, upper))
        size[size == 0.0] = 1.0
        downhill = np.append(r[:-1, -1], np.zeros(len(size)))
        while damping < 1e8 and np.isfinite(r).all():
            damped = np.vstack([upper / size, sqrt(damping) * np.eye(len(size))])
            step = np.linalg.lstsq(damped, downhill, rcond=None)[0] / size
            new = _moved(best.point, step, gap_free, samples)
            if largest_pole(new.a) <= 1.0:
                tried, new_rows = evaluate(samples, structure, new)
                if tried.squares < best.squares:
                    best, rows, damping = tried, new_rows, max(0.2 * damping, 1e-12)
                    break
            damping *= 5.0
        if not best.squares < before * (1.0 - 1e-6):
            break
    return best


def _moved(point: Point, step: Array, gap_free: bool, samples: Samples) -> Point:
    """Gap and start stay where they can be."""
    count, v0 = len(point.a), float(samples.v[0])
    swing = float(np.ptp(samples.v))
    gap = min(max(point.gap + float(step[count]), 0.0), swing) if gap_free else point.gap
    return Point(
        point.a + step[:count], gap, min(max(point.start + float(step[-1]), v0), v0 + gap))


def largest_pole(a: Array) -> float:
    """Magnitude of the largest root of z^n + a[0] z^(n-1) + ..., 0 for none; inf for no number."""
    if not np.isfinite(a).all():
        return inf
    if len(a) == 1:
        return abs(float(a[0]))
    return float(np.abs(np.roots(np.append(1.0, a))).max(initial=0.0))


def steiglitz_mcbride(
    samples: Samples, structure: Structure, p: Array, filters: Sequence[float] = FILTERS,
) -> list[Array]:
    """Free coefficients of A for a play output p (N,), the best first; at least one."""
    poles, count, known = structure.free_poles, samples.count, samples.known
    tried: list[tuple[float, int, Array]] = [(inf, 0, np.zeros(poles))]
    if not poles:
        return [np.zeros(0)]
    y = np.interp(np.arange(count), known, samples.y[known]) - samples.middle
    back = np.zeros((poles, count))
    for first in filters:
        a = np.asarray(np.poly([first] * poles)[1:], dtype=float)
        for step in range(3):
            # A y over A: with an integrator in both, 1 - 1/z cancels.
            filtered = lfilter([1.0], np.append(1.0, a), y)
            for j in range(poles):
                back[j, j + 1:] = -filtered[:count - j - 1]
            rows = np.vstack([linear_rows(samples, structure, a, p), back, filtered])
            better = solved(triangle(samples.reduced(rows)))[-poles:]
            if not np.isfinite(better).all():
                break
            a = _stable(better)
            if step:  # the first leads nowhere yet
                tried.append((squares_of(samples, structure, a, p), len(tried), a))
    return [a for _, _, a in sorted(tried, key=lambda one: one[:2])]


def _stable(a: Array) -> Array:
    """The same with poles outside of the unit circle put inside."""
    inside = 0.999  # where poles outside of the unit circle are put
    if largest_pole(a) <= inside:
        return a
    poles = np.roots(np.append(1.0, a))
    size = np.abs(poles)
    return np.real(np.poly(poles * np.minimum(inside / np.maximum(size, inside), 1.0)))[1:]
