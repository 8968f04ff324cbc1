"""What is not a play, or not that alone, named by what it is.

Another nonlinearity takes the place of the play, and is compared with it through one and the same
general linear family: taps, lags of several lengths, an integral, an offset, a drift and a
characteristic that is not straight. These are solved for exactly, so that no comparison depends on
the G that was fitted with a play. What moves y beside v is told by the residual of that fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import copysign
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter

Array = NDArray[np.float64]
Figures = dict[str, float | str] | None

LAG_LENGTHS = (0.7, 2.0, 6.0, 20.0, 60.0)  # [samples]
EXPLAINED = 0.95  # share of what a play leaves beyond the noise that another one must explain
REST = 8  # samples of v at rest, behind as many in which y settles


class Candidate(NamedTuple):
    """Squares that a nonlinearity leaves, its parameters, and what it has y follow."""

    squares: float
    at: tuple[float, ...]
    columns: Array


class LinearFamily:
    """Everything linear between the output of a nonlinearity (N,) and y (N,), nan where lost.

    v: scaled to 0 to 1, as are the parameters of nonlinearities.
    """

    def __init__(self, v: Array, y: Array) -> None:
        self.low, self.swing = float(v.min()), max(float(np.ptp(v)), 1e-300)
        self.v = (v - self.low) / self.swing
        known = np.flatnonzero(np.isfinite(y) & (np.arange(len(y)) >= min(len(y) // 10, 100)))
        self.rows = known[::max(len(known) // 1500, 1)]
        self.target = y[self.rows]
        bend = self.v - self.v.mean()
        self.common = np.column_stack([
            np.ones(len(v)), np.linspace(-1.0, 1.0, len(v)), bend**2, bend**3])[self.rows]

    def columns(self, w: Array) -> Array:
        """Three taps, lags and, last, the integral of w (N,)."""
        w = w - w.mean()
        steps = np.diff(w, prepend=[w[0], w[0]])
        found = [w, steps[1:], np.diff(steps)]
        for lag in LAG_LENGTHS:
            a = float(np.exp(-1.0 / lag))
            found.append(lfilter([1.0 - a], [1.0, -a], w, state=[w[0] * a]))
        return np.column_stack([*found, np.cumsum(w)])[self.rows]

    def solved(self, columns: Array, part: slice = slice(None)) -> tuple[float, Array]:
        """Squares left over of a part of the rows, and the solution for columns and `common`."""
        whole, target = np.column_stack([columns, self.common])[part], self.target[part]
        scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
        scale[scale == 0.0] = 1.0
        whole /= scale
        solution = np.linalg.lstsq(whole.T @ whole, whole.T @ target, rcond=1e-13)[0]
        left = target - whole @ solution
        return float(left @ left), solution / scale

    def best(
        self, nonlinearity: Callable[..., Array], starts: Sequence[tuple[float, ...]],
        evaluations: int = 50,
    ) -> Candidate:
        """The best parameters of a nonlinearity of v, from the best two starts."""
        from scipy.optimize import minimize  # a fifth of the time that a start takes

        def left(at: Sequence[float]) -> float:
            w = nonlinearity(self.v, *at)
            return self.solved(self.columns(w))[0] if np.ptp(w) > 0.0 else 1e300

        found = sorted((left(at), at) for at in starts)[:2]
        for _, at in list(found):
            result = minimize(left, at, method='Nelder-Mead',
                              options={'maxfev': evaluations, 'xatol': 1e-4})
            found.append((float(result.fun), tuple(result.x.tolist())))
        squares, at = min(found)
        return Candidate(squares, at, self.columns(nonlinearity(self.v, *at)))

    def changing(self, gap: float, basis: Array) -> tuple[Array, Candidate]:
        """Gaps [v] of a basis (B, N) that make up the width of a play, from a constant gap.

        Gauss-Newton steps: the linear system, and the widths with it.
        """
        widths: Array = np.full(len(basis), max(gap / self.swing, 1e-4))
        best = widths, Candidate(np.inf, (), np.empty(0))
        for _ in range(8):
            half, place = 0.5 * np.maximum(widths @ basis, 0.0), float(self.v[0])
            held = []
            for low, high in zip((self.v - half).tolist(), (self.v + half).tolist(), strict=True):
                place = min(max(place, low), high)
                held.append(place)
            p = np.array(held)
            columns = self.columns(p)
            squares, solution = self.solved(columns)
            if not squares < best[1].squares:
                break
            best = widths, Candidate(squares, (), columns)
            side = np.where(p == self.v - half, -0.5, np.where(p == self.v + half, 0.5, 0.0))
            last = np.maximum.accumulate(np.where(side != 0.0, np.arange(len(side)), 0))
            moved = [self.columns((side * one)[last]) @ solution[:columns.shape[1]]
                     for one in basis]
            widths = widths + self.solved(np.column_stack([*moved, columns]))[1][:len(basis)]
        return self.swing * np.maximum(best[0], 0.0), best[1]

    def share(self, other: Candidate, one: Candidate, noise: float) -> float:
        """Of what `one` leaves beyond the noise, what `other` explains; 0 where that is chance."""
        beyond = max(one.squares - noise**2 * len(self.rows), 1e-300)
        # Neighbours of smooth residuals tell little of their own.
        gain = 0.2 * len(self.rows) * np.log(one.squares / max(other.squares, 1e-300))
        return (one.squares - other.squares) / beyond if gain >= 15.0 else 0.0

    def beats(self, other: Candidate, one: Candidate, noise: float) -> bool:
        """The same in both halves: what happens to fit one part does not fit the other."""
        half = len(self.rows) // 2
        return self.share(other, one, noise) >= EXPLAINED and all(
            self.solved(other.columns, part)[0]
            < (1.0 - 0.5 * EXPLAINED) * self.solved(one.columns, part)[0]
            for part in (slice(0, half), slice(half, None))
        )


@dataclass(frozen=True)
class Observed:
    """A record and its fit, N samples each. y: nan where lost. p: play output [v], as it acts on y
    (the delay is in it). simulated: y without noise. noise: standard deviation of white noise and
    rounding of y. gap: that of p."""

    v: Array
    y: Array
    p: Array
    simulated: Array
    noise: float
    gap: float

    @property
    def residual(self) -> Array:
        """y less what was simulated."""
        return np.asarray(self.y - self.simulated)

    @property
    def rms(self) -> float:
        """Of the residual."""
        return float(np.sqrt(np.nanmean(self.residual**2)))

    @property
    def swing(self) -> float:
        """Of y."""
        return float(np.nanmax(self.y) - np.nanmin(self.y))

    @property
    def unexplained(self) -> bool:
        """Whether the residual is more than noise."""
        return self.rms > max(1.5 * self.noise, 1e-3 * self.swing)

    @cached_property
    def family(self) -> LinearFamily | None:
        """To compare nonlinearities by; None where there is too little."""
        part = slice(0, min(len(self.v), 4000))
        family = LinearFamily(self.v[part], self.y[part])
        return family if np.ptp(family.v) > 0.0 and len(family.rows) >= 100 else None

    @cached_property
    def one_play(self) -> Candidate:
        """The best play."""
        assert self.family is not None
        widths = (6e-4, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, self.gap / self.family.swing)
        return self.family.best(centred, [(width,) for width in widths])

    @cached_property
    def coasting(self) -> Candidate:
        """The best play with a load that coasts within it."""
        assert self.family is not None
        best = self.one_play.at[0]
        return self.family.best(coasting, [
            (width, *brakes) for width in (best, 1.3 * best, 1.3 * self.gap / self.family.swing)
            for brakes in ((0.0, 0.0), (3e-4, 0.0), (3e-3, 0.0), (0.0, 0.03), (0.0, 0.2))], 100)


class Answer(NamedTuple):
    """Whether something is known; what, or why not; and what to do about it."""

    known: bool
    reason: str
    cure: str = ''

    @property
    def sentence(self) -> str:
        """Reason and cure."""
        return f'{self.reason}: {self.cure}' if self.cure else self.reason


# --- nonlinearities of v (N,), scaled to 0 to 1 ---------------------------------------------------


def centred(v: Array, width: float) -> Array:
    """Play about its middle."""
    width = abs(width)
    return play(v, width, float(v[0]) + 0.5 * width) - 0.5 * width


def _ended(v: Array, width: float, low: float, high: float, beyond: float = 0.0) -> Array:
    """Play with two ends, and a share of its motion beyond these."""
    p = centred(v, width)
    within = np.clip(p, min(low, high), max(low, high))
    return np.asarray(within + beyond * (p - within))


def _dead(v: Array, low: float, high: float) -> Array:
    """Dead zone."""
    return np.asarray(v - np.clip(v, min(low, high), max(low, high)))


def _leading(v: Array, width: float) -> Array:
    """Play, compensated twice."""
    return np.asarray(2.0 * v - centred(v, width))


def coasting(v: Array, width: float, dry: float, viscous: float) -> Array:
    """Play with a load that runs on from the side that it leaves, braked by dry friction and by a
    share of its speed each sample."""
    half, dry, kept = 0.5 * abs(width), abs(dry), 1.0 - min(abs(viscous), 1.0)
    place, speed, out = float(v[0]), 0.0, []
    for value in v.tolist():
        speed = copysign(max(kept * abs(speed) - dry, 0.0), speed)
        on = min(max(place + speed, value - half), value + half)
        if on != place + speed:
            speed = on - place
        place = on
        out.append(place)
    return np.array(out)


def _many(v: Array, widest: float, share: float) -> Array:
    """Plays of all widths up to the widest in parallel, and a share of v itself beside them."""
    widths = abs(widest) * np.linspace(0.04, 0.96, 12, dtype=np.float64)
    held = play(v, widths, v[0] + 0.5 * widths) - 0.5 * widths[:, None]
    share = min(max(share, 0.0), 1.0)
    return np.asarray(share * v + (1.0 - share) * held.mean(axis=0))


def _sticking(v: Array, band: float, jump: float) -> Array:
    """Stick band behind each turn of v, and the jump at its end (M. A. A. Shoukat Choudhury, N. F.
    Thornhill, S. L. Shah, Control Eng. Practice 13 (2005) 641-658)."""
    band, jump = abs(band), min(abs(jump), abs(band))
    place = stop = last = float(v[0])
    way, out = 0, []
    for value in v.tolist():
        if (value - last) * way < 0.0:
            stop, way = last, 0
        if not way and abs(value - stop) > band:
            way = 1 if value > stop else -1
        if way:
            place = value - 0.5 * way * (band - jump)
        last = value
        out.append(place)
    return np.array(out)


# --- figures of the sentences, None where a test finds nothing ------------------------------------


def _end(o: Observed, family: LinearFamily, at: tuple[float, ...]) -> Figures:
    width, low, high = at
    squares = [family.solved(family.columns(_ended(family.v, width, low, high, beyond)))[0]
               for beyond in (0.0, 0.3)]
    p = centred(family.v, width)
    on, y = max(((float(beyond.max()), family.target[beyond[family.rows] > 0.0])
                 for beyond in (p - max(low, high), min(low, high) - p)), key=lambda end: end[0])
    # A y that only moves less there is at no end.
    if squares[1] < squares[0] or on < 0.1 or not len(y):
        return None
    return {'end': float(np.median(y)), 'on': family.swing * on}


def _zone(_: Observed, family: LinearFamily, at: tuple[float, ...]) -> Figures:
    low, high = sorted(at)
    return {'low': family.low + family.swing * low, 'high': family.low + family.swing * high}


def _lead(o: Observed, family: LinearFamily, at: tuple[float, ...]) -> Figures:
    further = abs(at[0]) > abs(o.one_play.at[0]) + 0.002
    return {'lead': family.swing * abs(at[0])} if further else None


def _widest(_: Observed, family: LinearFamily, at: tuple[float, ...]) -> Figures:
    return {'widest': family.swing * abs(at[0])}


def _stuck(_: Observed, family: LinearFamily, at: tuple[float, ...]) -> Figures:
    band, jump = abs(at[0]), min(abs(at[1]), abs(at[0]))
    return {'band': family.swing * band, 'jump': family.swing * jump} if jump > 0.1 * band else None


def _held(o: Observed) -> Figures:
    """A y that is seen at its end while v goes on."""
    known = np.isfinite(o.y)
    # About 1 or -1, but next to 0 where G integrates.
    along = float(np.corrcoef(o.v[known], o.y[known])[0, 1])
    within = 4.0 * o.noise + 0.005 * o.swing
    # What would move y by far more, if it moved.
    far = max(0.1, 3.0 * within / o.swing) * float(np.ptp(o.v))
    for end, way in ((np.nanpercentile(o.y, 98.0), 1.0), (np.nanpercentile(o.y, 2.0), -1.0)):
        on = [float(np.max((o.v[run] - o.v[run[0]]) * way * np.sign(along)))
              for run in _runs(np.abs(o.y - end) < within)]
        if abs(along) > 0.3 and sum(size > far for size in on) >= 3:
            return {'end': float(end), 'on': max(on)}
    return None


def _pushed(o: Observed) -> Figures:
    """A y that moves while v is at rest."""
    rest = np.append(False, (np.diff(o.v) == 0.0) & (np.diff(o.p) == 0.0))
    parts = [o.residual[run[REST:]] for run in _runs(rest)]
    moved = [float(np.nanmax(part) - np.nanmin(part)) for part in parts
             if np.isfinite(part).sum() >= REST]
    # Of white noise, the range of a few dozen readings is some four deviations.
    clear = [size for size in moved if size > max(5.0 * o.noise, 0.02 * o.swing)]
    return {'moved': max(clear)} if len(clear) >= max(2.0, 0.2 * len(moved)) else None


def _creep(o: Observed) -> Figures:
    """A y that goes away though v returns."""
    family = LinearFamily(o.v, o.y)
    # Of a G that integrates, y is where it has been driven to.
    columns = family.columns((o.p - family.low) / family.swing)
    left, without = family.solved(columns[:, :-1])
    # The integral of a p that is not about 0 on the average is a drift of its own.
    by_time = min(float(family.solved(columns)[1][-3]), float(without[-3]), key=abs)
    returning = float(np.ptp(family.target - by_time * family.common[:, 1]))
    turns = float(np.abs(np.diff(o.p)).sum()) / (2.0 * max(float(np.ptp(o.p)), 1e-300))
    explained = left < 0.1 * float(np.var(family.target)) * len(family.target)
    if not explained or abs(2.0 * by_time) < 0.3 * returning or turns < 3.0:
        return None
    return {'way': 2.0 * by_time, 'each': 2.0 * by_time / turns}


def _stick_slip(o: Observed) -> Figures:
    """A y that stays where it should move, and then jumps, how far ever."""
    fewest_moves = 20
    known = np.flatnonzero(np.isfinite(o.y) & np.append(False, np.diff(o.p) != 0.0))
    simulated, y, moved = o.simulated[known], o.y[known], 8.0 * o.noise
    # From each reading to the one by which y should have moved clearly.
    path = np.append(0.0, np.cumsum(np.abs(np.diff(simulated))))[:len(known)]
    ahead = np.searchsorted(path, path + moved)
    begin = np.flatnonzero(ahead < len(y))
    should = simulated[ahead[begin]] - simulated[begin]
    clear = np.abs(should) > 0.5 * moved
    if np.count_nonzero(clear) < fewest_moves:
        return None
    share = (y[ahead[begin]] - y[begin])[clear] / should[clear]
    stuck = float(np.mean(np.abs(share) < 0.3))
    if stuck < 0.35 or np.mean(share > 2.0) < 0.04:
        return None
    return {'stuck': stuck, 'jump': float(np.percentile(np.abs(np.diff(y)), 99.0))}


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """The indices of each run of true ones."""
    true = np.flatnonzero(flags)
    return np.split(true, np.flatnonzero(np.diff(true) > 1) + 1) if len(true) else []


# --- what is compared, and what is said -----------------------------------------------------------

AT_END = ('y stays at about {end:.4g} while v goes on by {on:.3g} and more: the sensor is at its '
          'end, or the load slides there', 'move v less far')


class Other(NamedTuple):
    """A nonlinearity, parameters to begin with, what a sentence needs of it, and what to say."""

    nonlinearity: Callable[..., Array]
    starts: Callable[[float], Sequence[tuple[float, ...]]]  # of the width of the best play
    figures: Callable[[Observed, LinearFamily, tuple[float, ...]], Figures]
    reason: str
    cure: str


NONLINEARITIES = (
    Other(_ended, lambda width: [
        (one, low, high) for one in (width, 0.0)
        for low, high in ((-1.0, 0.75), (0.25, 2.0), (0.2, 0.8), (0.35, 0.65))], _end, *AT_END),
    Other(_dead, lambda _: [(middle - half, middle + half) for middle in (0.3, 0.5, 0.7)
                            for half in (0.03, 0.1, 0.2, 0.3)], _zone,
          'v does nothing from {low:.4g} to {high:.4g}, from wherever it comes: a dead zone, which '
          'has no memory, and no backlash',
          'remove it where it is made, it is not compensated here'),
    Other(_leading, lambda _: [(width,) for width in (0.003, 0.01, 0.03, 0.1, 0.2, 0.4)], _lead,
          'y leads v by {lead:.3g} where v turns: the drive compensates a backlash already, by too '
          'much', 'switch that off, or leave it to it'),
    Other(_many, lambda _: [(widest, share) for widest in (0.1, 0.3, 0.7) for share in (0.0, 0.4)],
          _widest, 'many plays in parallel explain it, up to {widest:.3g} wide: y turns smoothly, '
          'as with friction along the way or in a piezo',
          'only a single backlash is compensated here'),
    Other(_sticking, lambda width: [(wider * width, share * width) for wider, share in (
        (1.05, 0.1), (1.3, 0.4), (1.3, 0.8), (1.0, 0.6))], _stuck,
          'y sticks until v has gone on by {band:.3g} behind each turn, and jumps by what {jump:.3g'
          '} of v move: friction, as in a valve', 'loosen it'),
)
BESIDE_V = (
    (_held, *AT_END),
    (_pushed, 'y moves by up to {moved:.3g} while v is at rest: something else moves the load',
     'hold it, or keep it free'),
    (_creep, 'y creeps by {way:.3g} over the record, {each:.3g} for each motion to and fro, though '
     'v returns: the way is not the same in both directions, or y drifts',
     'mend what slips, or measure y without a drift'),
)
LEFT_OVER = (
    (_stick_slip, 'y sticks and slips: it stays for {stuck:.0%} of the time in which it should '
     'move, and goes on in jumps of up to {jump:.2g}: friction', 'loosen it, or move faster'),
)


def what_it_is(o: Observed) -> Answer | None:
    """What else than one play y shows; None where one explains it."""
    if not o.unexplained:
        return None
    return _first(o, BESIDE_V) or best_other(o) or _first(o, LEFT_OVER)


def best_other(o: Observed) -> Answer | None:
    """The best of the nonlinearities that explain y far better than a play does."""
    family, found = o.family, []
    if family is None:
        return None
    for other in NONLINEARITIES:
        best = family.best(other.nonlinearity, other.starts(abs(o.one_play.at[0])))
        figures = family.beats(best, o.one_play, o.noise) and other.figures(o, family, best.at)
        if figures:
            found.append((best.squares, other.reason.format(**figures), other.cure))
    return Answer(False, *min(found)[1:]) if found else None


def _first(
    o: Observed, symptoms: Sequence[tuple[Callable[[Observed], Figures], str, str]],
) -> Answer | None:
    for test, reason, cure in symptoms:
        figures = test(o)
        if figures is not None:
            return Answer(False, reason.format(**figures), cure)
    return None
