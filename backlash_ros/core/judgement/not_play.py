"""Recognise and name what is not a play, or not a play alone.

Another nonlinearity replaces the play in front of a family of linear systems, which is solved for
exactly: the comparison depends on no G that was fitted with a play. What moves y besides v shows in
the residual of the fit. Tests return a sentence, or '' if they find nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.plant.backlash import clamp, play
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import Array

At = tuple[float, ...]  # parameters of a nonlinearity


class Answer(NamedTuple):
    """Whether something is known; what is known, or why it is not; and the cure."""

    known: bool
    reason: str
    cure: str = ''

    @property
    def sentence(self) -> str:
        return f'{self.reason}: {self.cure}' if self.cure else self.reason


class Candidate(NamedTuple):
    """Sum of squares that a nonlinearity leaves, its parameters, and the regressors of y."""

    squares: float
    at: At
    columns: Array


class LinearFamily:
    """Linear systems from the output of a nonlinearity (N,) to y (N,), nan where lost. v: scaled to
    the range 0 to 1, as are the parameters of nonlinearities. rows: samples that are compared.
    """

    def __init__(self, v: Array, y: Array) -> None:
        self.low, self.swing = float(v.min()), max(float(np.ptp(v)), 1e-300)
        self.v = (v - self.low) / self.swing
        known = np.flatnonzero(np.isfinite(y) & (np.arange(len(y)) >= min(len(y) // 10, 100)))
        self.rows = known[::max(len(known) // 1500, 1)]
        self.target = y[self.rows]
        self.enough = len(self.rows) >= 100 and bool(np.ptp(v) > 0.0)
        bend = self.v - self.v.mean()
        self.common = np.column_stack([
            np.ones(len(v)), np.linspace(-1.0, 1.0, len(v)), bend**2, bend**3])[self.rows]

    def columns(self, w: Array) -> Array:
        """Regressors of y: three taps, several lags and, last, the integral of w (N,)."""
        w = w - w.mean()
        steps = np.diff(w, prepend=[w[0], w[0]])
        found = [w, steps[1:], np.diff(steps)]
        for lag in (0.7, 2.0, 6.0, 20.0, 60.0):  # [samples]
            a = float(np.exp(-1.0 / lag))
            found.append(lfilter([1.0 - a], [1.0, -a], w, state=[w[0] * a]))
        return np.column_stack([*found, np.cumsum(w)])[self.rows]

    def solved(self, columns: Array, part: slice = slice(None)) -> tuple[float, Array]:
        """Solve a part of the rows: the sum of squares left, weights of columns and `common`."""
        whole, target = np.column_stack([columns, self.common])[part], self.target[part]
        scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
        scale[scale == 0.0] = 1.0
        whole /= scale
        solution = np.linalg.lstsq(whole.T @ whole, whole.T @ target, rcond=1e-13)[0]
        left = target - whole @ solution
        return float(left @ left), solution / scale

    def best(
        self, nonlinearity: Callable[..., Array], starts: Sequence[At], evaluations: int = 50,
    ) -> Candidate:
        """Fit the parameters of a nonlinearity of v, beginning with the best two starts."""
        from scipy.optimize import minimize  # here, as it takes a fifth of the start-up time

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
        """Fit a play whose width is a sum of basis functions (B, N) by Gauss-Newton steps from a
        constant gap. Returns their coefficients [v] (B,) and the fit."""
        widths: Array = np.full(len(basis), max(gap / self.swing, 1e-4))
        best = widths, Candidate(np.inf, (), np.empty(0))
        for _ in range(8):
            half, place, held = 0.5 * np.maximum(widths @ basis, 0.0), float(self.v[0]), []
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
        """Share of what `one` leaves beyond the noise that `other` explains; 0 if it is chance."""
        beyond = max(one.squares - noise**2 * len(self.rows), 1e-300)
        # White residuals have a factor of 0.5: smooth ones tell less, as neighbours are alike.
        gain = 0.2 * len(self.rows) * np.log(one.squares / max(other.squares, 1e-300))
        return (one.squares - other.squares) / beyond if gain >= 15.0 else 0.0

    def beats(self, other: Candidate, one: Candidate, noise: float) -> bool:
        """Whether `other` explains nearly all of that, and much in each half of the record."""
        explained, half = 0.95, len(self.rows) // 2
        return self.share(other, one, noise) >= explained and all(
            self.solved(other.columns, part)[0]
            < (1.0 - 0.5 * explained) * self.solved(one.columns, part)[0]
            for part in (slice(0, half), slice(half, None)))


@dataclass
class Observed:
    """A record and its fit, N samples each. y: nan where lost. p: play output [v] that acts on y.
    noise: standard deviation of white noise and rounding of y. gap: of that play. unexplained:
    whether the residual exceeds noise. family: compares nonlinearities, over the first samples."""

    v: Array
    y: Array
    p: Array
    simulated: Array
    noise: float
    gap: float

    def __post_init__(self) -> None:
        self.residual: Array = self.y - self.simulated
        self.rms = float(np.sqrt(np.nanmean(self.residual**2)))
        self.swing = float(np.nanmax(self.y) - np.nanmin(self.y))
        self.family = LinearFamily(self.v[:4000], self.y[:4000])
        self.unexplained = self.family.enough and \
            self.rms > max(1.5 * self.noise, 1e-3 * self.swing)

    @cached_property
    def one_play(self) -> Candidate:
        """The best single play."""
        widths = (6e-4, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8, self.gap / self.family.swing)
        return self.family.best(centred, [(width,) for width in widths])

    @cached_property
    def plays(self) -> Candidate:
        """The best set of many plays in parallel."""
        return self.family.best(
            _many, [(widest, share) for widest in (0.1, 0.3, 0.7) for share in (0.0, 0.4)])

    def share(self, other: Candidate) -> float:
        """Share of what the best play with any G leaves, beyond noise, that `other` explains."""
        # The family lacks some G: the best play explains no less than the fit does.
        left = float(np.sum(self.residual[self.family.rows]**2))
        one = self.one_play._replace(squares=min(left, self.one_play.squares))
        return min(self.family.share(other, one, self.noise), 1.0)


# --- nonlinearities of v (N,), which is scaled to 0 to 1 ------------------------------------------


def centred(v: Array, width: float) -> Array:
    """Output of a play, less half its gap so that it is centred on v."""
    width = abs(width)
    return play(v, width, float(v[0]) + 0.5 * width) - 0.5 * width


def coasting(v: Array, width: float, dry: float, viscous: float) -> Array:
    """Play with a load that runs on when it leaves a side; in each sample its speed [v/sample]
    falls by `dry` and by the share `viscous`."""
    half, dry, kept = 0.5 * abs(width), abs(dry), 1.0 - min(abs(viscous), 1.0)
    place, speed, out = float(v[0]), 0.0, []
    for value in v.tolist():
        speed = max(kept * speed - dry, 0.0) if speed > 0.0 else min(kept * speed + dry, 0.0)
        on = clamp(place + speed, value - half, value + half)
        if on != place + speed:
            speed = on - place
        place = on
        out.append(place)
    return np.array(out)


def limited(v: Array, step: float) -> Array:
    """What follows v (N,) by at most `step` per sample."""
    step, place, out = abs(step), float(v[0]), []
    for value in v.tolist():
        place += min(max(value - place, -step), step)
        out.append(place)
    return np.array(out)


def rate_limit(v: Array, y: Array) -> float | None:
    """Largest step per sample of a drive that turns jumps of v (N,) into ramps, as y (N,) shows.
    Returns None if a play explains y without such a limit, or if v never jumps."""
    jump = 0.05  # least step of v that may be too fast for the drive [swing of v]
    family = LinearFamily(v, y)
    largest = float(np.max(np.abs(np.diff(family.v)), initial=0.0))
    if largest < jump or not family.enough:
        return None

    def following(v: Array, octaves: float, width: float) -> Array:
        return centred(limited(v, largest * 2.0**octaves), width)

    play_alone = family.best(centred, [(width,) for width in (6e-4, 0.01, 0.1, 0.3)])
    slow = family.best(following, [
        (octaves, width) for octaves in (-1.0, -2.5, -4.0, -6.0) for width in (0.003, 0.03)])
    # The noise is not known yet: it counts as unexplained.
    if not family.beats(slow, play_alone, 0.0):
        return None
    # Once more: along a ramp, a small error of its slope adds up.
    octaves = family.best(following, [slow.at]).at[0]
    return float(family.swing * largest * 2.0**octaves)


def _many(v: Array, widest: float, share: float) -> Array:
    """Mean of plays of all widths up to the widest, in parallel with a share of v itself."""
    widths = abs(widest) * np.linspace(0.04, 0.96, 12, dtype=np.float64)
    held = play(v, widths, v[0] + 0.5 * widths) - 0.5 * widths[:, None]
    share = min(max(share, 0.0), 1.0)
    return np.asarray(share * v + (1.0 - share) * held.mean(axis=0))


def _sticking(v: Array, band: float, jump: float) -> Array:
    """Stiction: a stick band after each turn of v, and a jump at its end (M. A. A. Shoukat
    Choudhury, N. F. Thornhill, S. L. Shah, Control Eng. Practice 13 (2005) 641-658)."""
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


# --- what moves y besides v, or holds it ----------------------------------------------------------


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """The indices of each run of true flags."""
    true = np.flatnonzero(flags)
    return np.split(true, np.flatnonzero(np.diff(true) > 1) + 1) if len(true) else []


def _held(o: Observed) -> str:
    """Report a y that rests at an end of its range while v goes on."""
    known = np.isfinite(o.y)
    # About 1 or -1, but near 0 if G integrates.
    along = float(np.corrcoef(o.v[known], o.y[known])[0, 1])
    within = 4.0 * o.noise + 0.005 * o.swing
    # Travel of v that would move y by far more than `within` if it moved y at all.
    far = max(0.1, 3.0 * within / o.swing) * float(np.ptp(o.v))
    for end, way in ((np.nanpercentile(o.y, 98.0), 1.0), (np.nanpercentile(o.y, 2.0), -1.0)):
        on = [float(np.max((o.v[run] - o.v[run[0]]) * way * np.sign(along)))
              for run in _runs(np.abs(o.y - end) < within)]
        if abs(along) > 0.3 and sum(size > far for size in on) >= 3:
            return (f'y stays at about {float(end):.4g} while v goes on by {max(on):.3g} and more: '
                    'the sensor is at its end, or the load slides there')
    return ''


def _pushed(o: Observed) -> str:
    """Report a y that moves while v is at rest."""
    settled = 8  # samples of rest in which y settles, and least number to judge after them
    rest = np.append(False, (np.diff(o.v) == 0.0) & (np.diff(o.p) == 0.0))
    parts = [o.residual[run[settled:]] for run in _runs(rest)]
    moved = [float(np.nanmax(part) - np.nanmin(part)) for part in parts
             if np.isfinite(part).sum() >= settled]
    # The range of a few dozen readings of white noise is some four standard deviations.
    clear = [size for size in moved if size > max(5.0 * o.noise, 0.02 * o.swing)]
    return '' if len(clear) < max(2.0, 0.2 * len(moved)) else (
        f'y moves by up to {max(clear):.3g} while v is at rest: something else moves the load')


def _creep(o: Observed) -> str:
    """Report a y that drifts away although v returns."""
    f = LinearFamily(o.v, o.y)
    # If G integrates, its input may have driven y away: compared with and without an integral.
    columns = f.columns((o.p - f.low) / f.swing)
    left, without = f.solved(columns[:, :-1])
    # If the mean of p is not about 0, its integral is a drift of its own.
    by_time = min(float(f.solved(columns)[1][-3]), float(without[-3]), key=abs)
    returning = float(np.ptp(f.target - by_time * f.common[:, 1]))
    turns = float(np.abs(np.diff(o.p)).sum()) / (2.0 * max(float(np.ptp(o.p)), 1e-300))
    explained = left < 0.1 * float(np.var(f.target)) * len(f.target)
    if not explained or abs(2.0 * by_time) < 0.3 * returning or turns < 3.0:
        return ''
    return (f'y creeps by {2.0 * by_time:.3g} over the record, {2.0 * by_time / turns:.3g} for '
            'each motion to and fro, though v returns: the travel differs between the directions, '
            'or y drifts')


# --- what is compared -----------------------------------------------------------------------------

# A nonlinearity; its starts, given the width of the best play, or None for Observed.plays; what to
# say of it, with its parameters as sizes [v] and as `places` [v]; and the cure.
NONLINEARITIES: tuple[tuple[
    Callable[..., Array], Callable[[float], Sequence[At]] | None, str, str], ...
] = (
    (lambda v, width, low, high: np.clip(centred(v, width), min(low, high), max(low, high)),
     lambda width: [
         (one, low, high) for one in (width, 0.0)
         for low, high in ((-1.0, 0.75), (0.25, 2.0), (0.2, 0.8), (0.35, 0.65))],
     'y stays where it is while v goes on below {places[1]:.4g} or above {places[2]:.4g}: the '
     'sensor is at its end, or the load slides there', 'move v less far'),
    (lambda v, low, high: v - np.clip(v, min(low, high), max(low, high)),
     lambda _: [(middle - half, middle + half) for middle in (0.3, 0.5, 0.7)
                for half in (0.03, 0.1, 0.2, 0.3)],
     'v does nothing from {places[0]:.4g} to {places[1]:.4g}, wherever it comes from: a dead '
     'zone, which has no memory, not a backlash',
     'remove it where it is made, it is not compensated here'),
    # The lead comes at once when v turns, or over some travel after the turn.
    (lambda v, lead, way: v + abs(lead) * (v - centred(v, way)) / max(abs(way), 1e-9),
     lambda _: [(lead, lead) for lead in (0.003, 0.01, 0.03, 0.1, 0.2, 0.4)],
     'y leads v by {:.3g} where v turns: the drive compensates a backlash already, by too much',
     'switch that off, or leave the compensation to the drive'),
    (_many, None,
     'many plays in parallel explain it, up to {:.3g} wide: y turns smoothly, as with friction '
     'along the way or in a piezo', 'only a single backlash is compensated here'),
    (_sticking, lambda width: [(wider * width, share * width) for wider, share in (
        (1.05, 0.1), (1.3, 0.4), (1.3, 0.8), (1.0, 0.6))],
     'y sticks after each turn until v has gone on by {:.3g}, then jumps by {:.3g} (as a motion of '
     'v): friction, as in a valve', 'reduce the friction'),
)
BESIDE_V = ((_held, 'move v less far'), (_pushed, 'keep other forces off the load'),
            (_creep, 'fix what slips, or measure y without a drift'))


def what_it_is(o: Observed) -> Answer | None:
    """What y shows other than a single play; None if a play explains it."""
    if not o.unexplained:
        return None
    for test, cure in BESIDE_V:
        if reason := test(o):
            return Answer(False, reason, cure)
    return best_other(o)


def best_other(o: Observed) -> Answer | None:
    """The best of the nonlinearities that explain y far better than a play; None if none does."""
    f, named = o.family, []
    for nonlinearity, starts, said, cure in NONLINEARITIES:
        best = f.best(nonlinearity, starts(abs(o.one_play.at[0]))) if starts else o.plays
        if f.beats(best, o.one_play, o.noise):
            at = f.swing * np.array(best.at)
            named.append((best.squares, said.format(*np.abs(at), places=f.low + at), cure))
    return Answer(False, *min(named)[1:]) if named else None
