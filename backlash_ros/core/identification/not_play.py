"""What is not a play, or not that alone, named by what it is: one test for each, from data alone.

Every test asks one thing of v, y, the play output p that was fitted and the y simulated from it,
and returns the figures of its sentence, or None.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.identification.linear_family import Candidate, LinearFamily

Array = NDArray[np.float64]
Figures = dict[str, float] | None

PLAY_WIDTHS = (0.0006, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8)  # of a play, in swings of v
REST = 8  # samples of v at rest, behind as many in which y settles


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
    def swing(self) -> float:
        """Of y."""
        return float(np.nanmax(self.y) - np.nanmin(self.y))

    @property
    def unexplained(self) -> bool:
        """Whether the residual is more than noise."""
        left = float(np.sqrt(np.nanmean(self.residual**2)))
        return left > max(1.5 * self.noise, 1e-3 * self.swing)

    @cached_property
    def family(self) -> LinearFamily | None:
        """To compare nonlinearities by; None where there is too little."""
        part = slice(0, min(len(self.v), 4000))
        family = LinearFamily(self.v[part], self.y[part])
        return family if np.ptp(family.v) > 0.0 and len(family.rows) >= 100 else None

    @cached_property
    def widths(self) -> list[tuple[float, ...]]:
        """Of a play, to begin with."""
        return [*((float(np.ptp(self.v)) * share,) for share in PLAY_WIDTHS), (self.gap,)]

    @cached_property
    def one_play(self) -> Candidate:
        """The best play."""
        assert self.family is not None
        return self.family.best(self.family.play, self.widths)


class Answer(NamedTuple):
    """Whether something is known; what, or why not; and what to do about it."""

    known: bool
    reason: str
    cure: str = ''

    @property
    def sentence(self) -> str:
        """Reason and cure."""
        return f'{self.reason}: {self.cure}' if self.cure else self.reason


def saturation(o: Observed) -> Figures:
    """Play, then a load, or a sensor, that goes on no further while v does."""
    family = o.family
    if family is None:
        return None
    v, swing, known = family.v, float(np.ptp(family.v)), np.isfinite(o.y)
    # About 1 or -1, but next to 0 where G integrates.
    along = float(np.corrcoef(o.v[known], o.y[known])[0, 1])
    for end, way in ((np.nanpercentile(o.y, 98.0), 1.0), (np.nanpercentile(o.y, 2.0), -1.0)):
        within = 4.0 * o.noise + 0.005 * o.swing
        runs = _runs(np.abs(o.y - end) < within)
        on = [float(np.max((o.v[run] - o.v[run[0]]) * way * np.sign(along))) for run in runs]
        # What would move y by far more, if it moved.
        far = max(0.1, 3.0 * within / o.swing) * swing
        if abs(along) > 0.3 and sum(size > far for size in on) >= 3:
            return {'end': float(end), 'on': max(on)}

    def ended(width: float, low: float, high: float) -> Array:
        return np.clip(family.play(width), low, high)

    starts = [(width, float(v.min()) + low * swing, float(v.min()) + high * swing)
              for width in (o.one_play.at[0], 0.0)
              for low, high in ((-1.0, 0.75), (0.25, 2.0), (0.2, 0.8), (0.35, 0.65))]
    found = family.best(ended, starts)
    if not family.beats(found, o.one_play, o.noise, 0.6):
        return None
    width, low, high = found.at
    p = family.play(width)
    for beyond in (p - high, low - p):
        y, on_by = family.target[beyond[family.rows] > 0.0], float(beyond.max())
        # A y that only moves less there is at no end.
        moves = 0.3 * o.swing * on_by / swing + 3.0 * o.noise
        if on_by > 0.1 * swing and len(y) and np.ptp(np.percentile(y, [25.0, 75.0])) < moves:
            return {'end': float(np.median(y)), 'on': on_by}
    return None


def pushed(o: Observed) -> Figures:
    """A y that moves while v is at rest."""
    rest = np.append(False, (np.diff(o.v) == 0.0) & (np.diff(o.p) == 0.0))
    parts = [o.residual[run[REST:]] for run in _runs(rest)]
    moved = [float(np.nanmax(part) - np.nanmin(part)) for part in parts
             if np.isfinite(part).sum() >= REST]
    # Of white noise, the range of a few dozen readings is some four deviations.
    clear = [size for size in moved if size > max(5.0 * o.noise, 0.02 * o.swing)]
    return {'moved': max(clear)} if len(clear) >= max(2.0, 0.2 * len(moved)) else None


def creep(o: Observed) -> Figures:
    """A y that goes away though v returns."""
    family = LinearFamily(o.v, o.y)
    # Of a G that integrates, y is where it has been driven to.
    columns = family.columns(o.p)
    left, without = family.solved(columns[:, :-1])
    # The integral of a p that is not about 0 on the average is a drift of its own.
    by_time = min(float(family.solved(columns)[1][-3]), float(without[-3]), key=abs)
    returning = float(np.ptp(family.target - by_time * family.common[:, 1]))
    turns = float(np.abs(np.diff(o.p)).sum()) / (2.0 * max(float(np.ptp(o.p)), 1e-300))
    explained = left < 0.1 * float(np.var(family.target)) * len(family.target)
    if not explained or abs(2.0 * by_time) < 0.3 * returning or turns < 3.0:
        return None
    return {'way': 2.0 * by_time, 'each': 2.0 * by_time / turns}


def dead_zone(o: Observed) -> Figures:
    """A v that does nothing around a place, from wherever it comes."""
    family = o.family
    if family is None:
        return None
    v = family.v

    def zone(centre: float, half: float) -> Array:
        return np.asarray(np.sign(v - centre) * np.maximum(np.abs(v - centre) - abs(half), 0.0))

    middle, swing = 0.5 * float(v.max() + v.min()), float(np.ptp(v))
    found = family.best(zone, [(middle + swing * a, swing * b) for a in (-0.2, 0.0, 0.2)
                               for b in (0.03, 0.1, 0.2, 0.3)])
    if not family.beats(found, o.one_play, o.noise, 0.9):
        return None
    centre, half = found.at
    return {'low': centre - abs(half), 'high': centre + abs(half)}


def compensated(o: Observed) -> Figures:
    """A y that leads v where v turns."""
    family = o.family
    if family is None:
        return None
    leads = family.best(lambda width: 2.0 * family.v - family.play(width), o.widths)
    further = abs(leads.at[0]) > abs(o.one_play.at[0]) + 0.002 * float(np.ptp(family.v))
    beats = family.beats(leads, o.one_play, o.noise, 0.6)
    return {'lead': abs(leads.at[0])} if beats and further else None


def several_plays(o: Observed) -> Figures:
    """Plays in parallel, up to 0.7 swings of v wide."""
    family = o.family
    if family is None:
        return None
    steps = float(np.ptp(family.v)) * np.linspace(0.0, 0.7, 12)
    weights, several = family.parallel([family.play(width) for width in steps])
    count = int(np.count_nonzero(weights > 0.2 * weights.max()))
    if count < 3 or not family.beats(several, o.one_play, o.noise, 0.6):
        return None
    return {'count': count, 'widest': float(steps[weights > 0.0].max())}


def stick_slip(o: Observed) -> Figures:
    """A y that stays where it should move, and then jumps."""
    fewest_moves = 20  # moves that are looked at
    known = np.flatnonzero(np.isfinite(o.y) & np.append(False, np.diff(o.p) != 0.0))
    if len(known) < 3 * fewest_moves:
        return None
    simulated, y = o.simulated[known], o.y[known]
    # From each reading to the one by which y should have moved clearly.
    moved = 8.0 * o.noise
    path = np.append(0.0, np.cumsum(np.abs(np.diff(simulated))))
    ahead = np.searchsorted(path, path + moved)
    begin = np.flatnonzero(ahead < len(y))
    should = simulated[ahead[begin]] - simulated[begin]
    clear = np.abs(should) > 0.5 * moved
    if np.count_nonzero(clear) < fewest_moves:
        return None
    share = ((y[ahead[begin]] - y[begin]) / np.where(clear, should, 1.0))[clear]
    stuck = float(np.mean(np.abs(share) < 0.3))
    if stuck < 0.35 or np.mean(share > 2.0) < 0.04:
        return None
    return {'stuck': stuck, 'jump': float(np.percentile(np.abs(np.diff(y)), 99.0))}


def off_in_gap(o: Observed, onwards: bool) -> Figures:
    """A load that goes on the way that it went while v crosses the gap, or that is moved there."""
    if o.gap < 0.003 * float(np.ptp(o.v)):
        return None
    crossing = np.append(False, (np.diff(o.p) == 0.0) & (np.diff(o.v) != 0.0))
    known = np.isfinite(o.residual)
    within, engaged = o.residual[known & crossing], o.residual[known & ~crossing]
    if len(within) < 20 or len(engaged) < 20:
        return None
    inside, outside = (float(np.sqrt(np.mean(part**2))) for part in (within, engaged))
    if inside < 2.0 * max(outside, o.noise):
        return None
    # The way p went before it stopped.
    went = np.sign(np.append(0.0, np.diff(o.p)))
    before = went[np.maximum.accumulate(np.where(went != 0.0, np.arange(len(went)), 0))]
    on = np.mean(within * before[known & crossing]) > 0.5 * np.mean(np.abs(within))
    return {'inside': inside, 'outside': outside} if on == onwards else None


class Symptom(NamedTuple):
    """A test, what to say and to do where it finds something, and whether there is a play too."""

    test: Callable[[Observed], Figures]
    reason: str
    cure: str
    play_too: bool = False


IN_GAP = 'while v crosses the gap the load is off by {inside:.3g}, and by {outside:.3g} while ' \
    'it is pushed'
# Each of them would look like one of those below it as well.
SYMPTOMS = (
    Symptom(saturation, 'y stays at about {end:.4g} while v goes on by {on:.3g} and more: the '
            'sensor is at its end, or the load slides there', 'move v less far'),
    Symptom(pushed, 'y moves by up to {moved:.3g} while v is at rest: something else moves the '
            'load', 'hold it, or keep it free'),
    Symptom(creep, 'y creeps by {way:.3g} over the record, {each:.3g} for each motion to and fro, '
            'though v returns: the way is not the same in both directions, or y drifts',
            'mend what slips, or measure y without a drift'),
    Symptom(dead_zone, 'v does nothing from {low:.4g} to {high:.4g}, from wherever it comes: a '
            'dead zone, which has no memory, and no backlash',
            'remove it where it is made, it is not compensated here'),
    Symptom(compensated, 'y leads v by {lead:.3g} where v turns: the drive compensates a backlash '
            'already, by too much', 'switch that off, or leave it to it'),
    Symptom(several_plays, '{count} plays in parallel explain it, up to {widest:.3g} wide: y turns '
            'smoothly, as with friction along the way or in a piezo',
            'only a single backlash is compensated here'),
    Symptom(stick_slip, 'y sticks and slips: it stays for {stuck:.0%} of the time in which it '
            'should move, and goes on in jumps of up to {jump:.2g}: friction',
            'loosen it, or move faster'),
    Symptom(partial(off_in_gap, onwards=True), f'{IN_GAP}: it coasts there',
            'brake it, or move more slowly', True),
    Symptom(partial(off_in_gap, onwards=False), f'{IN_GAP}: something else moves it there',
            'hold it, or keep it free', True),
)


def what_it_is(o: Observed) -> Answer | None:
    """What else than one play y shows, known where there is a play too; None where one explains it.
    """
    if o.unexplained:
        for test, reason, cure, play_too in SYMPTOMS:
            figures = test(o)
            if figures is not None:
                return Answer(play_too, reason.format(**figures), cure)
    return None


def _runs(flags: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """The indices of each run of true ones."""
    true = np.flatnonzero(flags)
    return np.split(true, np.flatnonzero(np.diff(true) > 1) + 1) if len(true) else []
