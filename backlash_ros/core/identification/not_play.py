"""What is not a play, or not that alone, named by what it is.

Another nonlinearity takes the place of the play in the same family (linear_family.py); what moves
y beside v is told by the residual of the fit. Each test returns a sentence, empty where it finds
nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.linear_family import LinearFamily, Observed, centred
from backlash_ros.core.plant.backlash import play

Array = NDArray[np.float64]
At = tuple[float, ...]  # parameters of a nonlinearity


class Answer(NamedTuple):
    """Whether something is known; what, or why not; and what to do about it."""

    known: bool
    reason: str
    cure: str = ''

    @property
    def sentence(self) -> str:
        """Reason and cure."""
        return f'{self.reason}: {self.cure}' if self.cure else self.reason


# --- nonlinearities of v (N,), scaled to 0 to 1, and what is said of them -------------------------


def _ended(v: Array, width: float, low: float, high: float, beyond: float = 0.0) -> Array:
    """Play with two ends, and a share of its motion beyond these."""
    p = centred(v, width)
    within = np.clip(p, min(low, high), max(low, high))
    return np.asarray(within + beyond * (p - within))


def _end(o: Observed, f: LinearFamily, at: At) -> str:
    width, low, high = at
    squares = [f.solved(f.columns(_ended(f.v, width, low, high, beyond)))[0]
               for beyond in (0.0, 0.3)]
    p = centred(f.v, width)
    on, y = max(((float(beyond.max()), f.target[beyond[f.rows] > 0.0])
                 for beyond in (p - max(low, high), min(low, high) - p)), key=lambda end: end[0])
    # A y that only moves less there is at no end.
    there = squares[0] <= squares[1] and on >= 0.1 and len(y)
    return _at_end(float(np.median(y)), f.swing * on) if there else ''


def _at_end(y: float, on: float) -> str:
    return (f'y stays at about {y:.4g} while v goes on by {on:.3g} and more: the sensor is at its '
            'end, or the load slides there')


def _dead(v: Array, low: float, high: float) -> Array:
    return np.asarray(v - np.clip(v, min(low, high), max(low, high)))


def _zone(_: Observed, f: LinearFamily, at: At) -> str:
    low, high = (f.low + f.swing * end for end in sorted(at))
    return (f'v does nothing from {low:.4g} to {high:.4g}, from wherever it comes: a dead zone, '
            'which has no memory, and no backlash')


def _leading(v: Array, width: float) -> Array:
    """Play, compensated twice."""
    return np.asarray(2.0 * v - centred(v, width))


def _lead(o: Observed, f: LinearFamily, at: At) -> str:
    return (f'y leads v by {f.swing * abs(at[0]):.3g} where v turns: the drive compensates a '
            'backlash already, by too much') * (abs(at[0]) > abs(o.one_play.at[0]) + 0.002)


def _many(v: Array, widest: float, share: float) -> Array:
    """Plays of all widths up to the widest in parallel, and a share of v itself beside them."""
    widths = abs(widest) * np.linspace(0.04, 0.96, 12, dtype=np.float64)
    held = play(v, widths, v[0] + 0.5 * widths) - 0.5 * widths[:, None]
    share = min(max(share, 0.0), 1.0)
    return np.asarray(share * v + (1.0 - share) * held.mean(axis=0))


def _widest(_: Observed, f: LinearFamily, at: At) -> str:
    return (f'many plays in parallel explain it, up to {f.swing * abs(at[0]):.3g} wide: y turns '
            'smoothly, as with friction along the way or in a piezo')


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


def _stuck(_: Observed, f: LinearFamily, at: At) -> str:
    band, jump = abs(at[0]), min(abs(at[1]), abs(at[0]))
    return (f'y sticks until v has gone on by {f.swing * band:.3g} behind each turn, and jumps by '
            f'what {f.swing * jump:.3g} of v move: friction, as in a valve') * (jump > 0.1 * band)


# --- what moves y beside v, or is left over -------------------------------------------------------


def _held(o: Observed) -> str:
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
            return _at_end(float(end), max(on))
    return ''


def _pushed(o: Observed) -> str:
    """A y that moves while v is at rest."""
    settled = 8  # samples of v at rest, behind as many in which y settles
    rest = np.append(False, (np.diff(o.v) == 0.0) & (np.diff(o.p) == 0.0))
    parts = [o.residual[run[settled:]] for run in _runs(rest)]
    moved = [float(np.nanmax(part) - np.nanmin(part)) for part in parts
             if np.isfinite(part).sum() >= settled]
    # Of white noise, the range of a few dozen readings is some four deviations.
    clear = [size for size in moved if size > max(5.0 * o.noise, 0.02 * o.swing)]
    return '' if len(clear) < max(2.0, 0.2 * len(moved)) else (
        f'y moves by up to {max(clear):.3g} while v is at rest: something else moves the load')


def _creep(o: Observed) -> str:
    """A y that goes away though v returns."""
    f = LinearFamily(o.v, o.y)
    # Of a G that integrates, y is where it has been driven to.
    columns = f.columns((o.p - f.low) / f.swing)
    left, without = f.solved(columns[:, :-1])
    # The integral of a p that is not about 0 on the average is a drift of its own.
    by_time = min(float(f.solved(columns)[1][-3]), float(without[-3]), key=abs)
    returning = float(np.ptp(f.target - by_time * f.common[:, 1]))
    turns = float(np.abs(np.diff(o.p)).sum()) / (2.0 * max(float(np.ptp(o.p)), 1e-300))
    explained = left < 0.1 * float(np.var(f.target)) * len(f.target)
    if not explained or abs(2.0 * by_time) < 0.3 * returning or turns < 3.0:
        return ''
    return (f'y creeps by {2.0 * by_time:.3g} over the record, {2.0 * by_time / turns:.3g} for '
            'each motion to and fro, though v returns: the way is not the same in both directions, '
            'or y drifts')


def _stick_slip(o: Observed) -> str:
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
        return ''
    share = (y[ahead[begin]] - y[begin])[clear] / should[clear]
    stuck = float(np.mean(np.abs(share) < 0.3))
    if stuck < 0.35 or np.mean(share > 2.0) < 0.04:
        return ''
    return (f'y sticks and slips: it stays for {stuck:.0%} of the time in which it should move, '
            f'and goes on in jumps of up to {np.percentile(abs(np.diff(y)), 99.0):.2g}: friction')


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """The indices of each run of true ones."""
    true = np.flatnonzero(flags)
    return np.split(true, np.flatnonzero(np.diff(true) > 1) + 1) if len(true) else []


# --- what is compared -----------------------------------------------------------------------------


class Other(NamedTuple):
    """A nonlinearity, parameters to begin with, what to say of it, and the cure."""

    nonlinearity: Callable[..., Array]
    starts: Callable[[float], Sequence[At]]  # of the width of the best play
    said: Callable[[Observed, LinearFamily, At], str]
    cure: str


LESS_FAR = 'move v less far'
NONLINEARITIES = (
    Other(_ended, lambda width: [
        (one, low, high) for one in (width, 0.0)
        for low, high in ((-1.0, 0.75), (0.25, 2.0), (0.2, 0.8), (0.35, 0.65))], _end, LESS_FAR),
    Other(_dead, lambda _: [(middle - half, middle + half) for middle in (0.3, 0.5, 0.7)
                            for half in (0.03, 0.1, 0.2, 0.3)],
          _zone, 'remove it where it is made, it is not compensated here'),
    Other(_leading, lambda _: [(width,) for width in (0.003, 0.01, 0.03, 0.1, 0.2, 0.4)],
          _lead, 'switch that off, or leave it to it'),
    Other(_many, lambda _: [(widest, share) for widest in (0.1, 0.3, 0.7) for share in (0.0, 0.4)],
          _widest, 'only a single backlash is compensated here'),
    Other(_sticking, lambda width: [(wider * width, share * width) for wider, share in (
        (1.05, 0.1), (1.3, 0.4), (1.3, 0.8), (1.0, 0.6))], _stuck, 'loosen it'),
)
BESIDE_V = ((_held, LESS_FAR), (_pushed, 'hold it, or keep it free'),
            (_creep, 'mend what slips, or measure y without a drift'))
LEFT_OVER = ((_stick_slip, 'loosen it, or move faster'),)


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
        if family.beats(best, o.one_play, o.noise):
            found.append((best.squares, other.said(o, family, best.at), other.cure))
    named = [one for one in found if one[1]]
    return Answer(False, *min(named)[1:]) if named else None


def _first(o: Observed, tests: Sequence[tuple[Callable[[Observed], str], str]]) -> Answer | None:
    found = ((test(o), cure) for test, cure in tests)
    return next((Answer(False, reason, cure) for reason, cure in found if reason), None)
