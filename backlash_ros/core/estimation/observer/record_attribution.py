"""Which commands of a record acted, and which readings are outliers, by all y that came after.

Where another command acted over an interval, u was another one until the play output is the same
again, and y moves by what G makes of that. An outlier moves one y alone. Both leave a signature s
in the innovations e of the fit, whitened as by an observer:

    gain in log-likelihood = (s.e - s.s / 2) / sigma^2         another command: s is known
                             (s.e)^2 / (2 s.s sigma^2)         a command that nobody knows of, or
                                                               an outlier: its size is free

Where that is more than the odds against it, and remains so once all follows from it, it is
believed; the largest first, until there is none. sigma is told by the median of |e|: what is looked
for does not widen it. A fit that has taken in many wrong commands is wrong itself, and so fit and
commands are found in turn.

References: A. S. Willsky, H. L. Jones, A generalized likelihood ratio approach to the detection and
estimation of jumps in linear systems, IEEE Trans. Automatic Control 21 (1976) 108-112; C. Chen,
L.-M. Liu, Joint estimation of model parameters and outlier effects in time series, J. American
Statistical Association 88 (1993) 284-297.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from math import log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.constants import GATE, ODDS
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted, labelled
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.fit.window_fit import NO_RESIDUAL
from backlash_ros.core.estimation.observer.observer import RATIOS, gain_of
from backlash_ros.core.estimation.regression.play import play
from backlash_ros.core.estimation.regression.residuals import bulk_std
from backlash_ros.core.estimation.regression.resolution import resolution_of
from backlash_ros.core.plant.filtering import lfilter
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.intp]

TOLD, OTHER, UNKNOWN = range(3)  # rows of the commands that may have acted over an interval
SURPRISE = -0.5 * GATE**2  # log-odds of what nothing but y speaks for: an outlier is one as well
LOG_ODDS: Array = np.array([0.0, -log(ODDS), SURPRISE])  # of these rows
# Noise on u that innovations are whitened for, the likelier of these: the more of it, the shorter
# the signatures, but those of neighbours become alike.
WHITE = RATIOS[len(RATIOS) // 2:][:2]
FILLED = 3  # times that lost outputs are replaced by what was expected: those in a row
ROUNDS = 12  # fits, at most, that are made in turn with the choice of commands


class Attributed(NamedTuple):
    """v (N,) that acted over a record, and which y (N,) are outliers.

    unknown: intervals (N,) over which a command acted that nobody knows of.
    """

    v: Array
    outliers: Flags
    unknown: Flags


class _Choice(NamedTuple):
    """Which command acted over each interval (N,), by its row, and which y (N,) are outliers."""

    row: Places
    outliers: Flags


def as_told(v: Array) -> Attributed:
    """Nothing but what was told acted."""
    none = np.zeros(len(v), dtype=np.bool_)
    return Attributed(v, none, none)


def with_other_commands(
    result: Fitted, v: Array, y: Array, other: Array, around: Around, pace: Pace,
) -> Generator[None, None, tuple[Fitted, Attributed]]:
    """The fit around this with the commands that another one says have acted, and these.

    result: fit of v (N,) and y (N,) that says so; it stays where it says nothing. other: see
    `attributed`.
    """
    found = yield from attributed(result, v, y, other, pace)
    if not found.outliers.any() and np.array_equal(found.v, v):
        return result, found
    start, slope = result.beginning(found.v), result.solution.m
    known = np.where(found.outliers, np.nan, y)
    return (yield from fitted(found.v, known, around, start, slope, pace)), found


def attributed(
    result: Fitted, v: Array, y: Array, other: Array, pace: Pace,
) -> Generator[None, None, Attributed]:
    """What a fit says of v (N,) and y (N,), nan where lost, that it has taken in or refused.

    Stops between its steps. other: commands that may have acted instead (N,), nan where none may;
    where there is none at all, it says nothing.
    """
    if not (np.isfinite(other).any() and np.isfinite(y).any()):
        return as_told(v)
    commands = np.stack([v, other, v])  # the unknown ones are still to be found
    now = _Choice(np.full(len(v), TOLD, dtype=np.intp), np.zeros(len(v), dtype=np.bool_))
    for _ in range(ROUNDS):
        before, now = now, (yield from _chosen(result, commands, now, y))
        if np.array_equal(now.row, before.row) and np.array_equal(now.outliers, before.outliers):
            break
        acted, known = _acted(commands, now.row), np.where(now.outliers, np.nan, y)
        start, slope = result.beginning(acted), result.solution.m
        result = yield from labelled(acted, known, result.around, start, slope, pace)
    return Attributed(_acted(commands, now.row), now.outliers, now.row == UNKNOWN)


def _acted(commands: Array, row: Places) -> Array:
    return np.asarray(commands[row, np.arange(len(row))])


def _chosen(
    result: Fitted, commands: Array, now: _Choice, y: Array,
) -> Generator[None, None, _Choice]:
    """The likeliest choice, starting from the one that the fit has taken in."""
    model = result.fit.model
    gains = [gain.gain for ratio in WHITE if (gain := gain_of(model, ratio)) is not None]
    if result.solution.crossings is None or not gains:
        return now
    searches = [_Search(result, _Whitening(model, gain), commands, now.row, y) for gain in gains]
    search, here = min(
        ((each, each.at(now)) for each in searches), key=lambda pair: pair[1].noise_std
    )
    while True:
        yield
        places = search.likely(now, here)
        if not len(places):
            return search.without_expected(now, here)
        yield
        before, now = now, search.exchanged(now, places)
        expected, here = here, search.at(now)
        refused = search.refused(before, places, expected, here.e) % len(y)
        if len(refused):
            yield
            now.row[refused], now.outliers[refused] = before.row[refused], before.outliers[refused]
            here = search.at(now)


class _Whitening:
    """Makes innovations e = A/W r of residuals r, as an observer of G = B/A does.

    gain: of the observer, in its form. signatures: of an impulse of u and of y, shape (L,).
    """

    def __init__(self, model: StateModel, gain: Sequence[float]) -> None:
        transfer = model.transfer_function
        self._a, self._b = transfer.denominator, transfer.numerator[1:]
        self._w = self._a + np.append(0.0, transfer.state_space()[0] @ gain)
        impulse = np.eye(1, model.memory)[0]
        self.signatures: tuple[Array, Array] = (
            lfilter(self._b, self._w, impulse), lfilter(self._a, self._w, impulse),
        )

    def innovations(self, residual: Array, change: Array, known: Flags) -> Array:
        """e (N,) where u is another one by `change` (N,); 0 where y is not known."""
        r: Array = residual - lfilter(self._b, self._a, change)
        r[~known] = 0.0
        e: Array = lfilter(self._a, self._w, r)
        for _ in range(FILLED):
            # What is lost is what was expected: then its innovation is 0.
            r[~known] -= e[~known]
            e = lfilter(self._a, self._w, r)
        return np.where(known, e, 0.0)


class _Place(NamedTuple):
    """Play output (N,), innovations (N,) and their deviation, for some choice."""

    p: Array
    e: Array
    noise_std: float


class _Search:
    """Looks for places where another command acted, or where y is an outlier.

    Place `row N + k` stands for a command of interval k, and behind all of them there is one for
    each reading. taken: rows of the commands that the fit has taken in (N,).
    """

    def __init__(
        self, result: Fitted, whitening: _Whitening, commands: Array, taken: Places, y: Array,
    ) -> None:
        fit, solution, _ = result
        self._whitening, self._gap, self._p0 = whitening, solution.gap, solution.start
        self._m, self._commands = solution.m, commands
        self._least, self._most = np.nanmin(commands[:UNKNOWN]), np.nanmax(commands[:UNKNOWN])
        self._known = np.isfinite(y)
        residual = fit.samples.unweighted_residual(solution.posterior, y)
        self._residual = np.where(self._known, residual, 0.0)
        self._taken = self._play(taken)
        self._least_std = max(resolution_of(y) / sqrt(12.0), NO_RESIDUAL * fit.extent[0])
        self._open: Flags = np.append(np.isfinite(commands).ravel(), self._known)

    def at(self, choice: _Choice) -> _Place:
        """What follows from this choice."""
        p = self._play(choice.row)
        change, known = self._m * (p - self._taken), self._known & ~choice.outliers
        e = self._whitening.innovations(self._residual, change, known)
        return _Place(p, e, max(bulk_std(e[known]), self._least_std))

    def without_expected(self, now: _Choice, here: _Place) -> _Choice:
        """The same without outliers that this fit expects: they were none."""
        all_known = self.at(now._replace(outliers=np.zeros_like(now.outliers)))
        expected = np.abs(all_known.e) < GATE * here.noise_std
        return now._replace(outliers=now.outliers & ~expected)

    def _play(self, row: Places) -> Array:
        return play(_acted(self._commands, row), self._gap, self._p0)[0]

    def likely(self, now: _Choice, here: _Place) -> Places:
        """Places where that is likely, no two so close that one tells of the other."""
        (p, e, noise_std), (of_u, of_y) = here, self._whitening.signatures
        count, reach, e = len(e), len(of_u), e / noise_std
        seen = (self._known & ~now.outliers).astype(np.float64)
        towards, squares = _ahead(e, of_u), _ahead(seen, of_u**2)
        # Without what the play output remembers of it: `refused` looks at that as well.
        held = np.append(self._p0, p[:-1])
        there = np.clip(held, self._commands, self._commands + self._gap)
        move = (there - p) * (self._m / noise_std)
        wanted = np.divide(towards, squares, out=np.zeros(count), where=squares > 0.0)
        leads = p + wanted * (noise_std / self._m)
        # It was sent some time: no further than those that are known.
        leads = np.clip(
            leads, np.minimum(held, self._least + self._gap), np.maximum(held, self._most)
        )
        move[UNKNOWN] = (leads - p) * (self._m / noise_std)
        of_commands = move * towards - 0.5 * move**2 * squares
        of_outliers = 0.5 * _ahead(e, of_y)**2 / float(of_y @ of_y)
        gains = np.append(of_commands.ravel(), of_outliers) - self._against(now)
        # Those that act; but an unknown one may turn out to be yet another one.
        self._open[now.row * count + np.arange(count)] &= now.row == UNKNOWN
        self._open[-count:] &= ~now.outliers
        likely = np.flatnonzero(self._open & (gains > 0.0))
        places: list[int] = []
        free = np.ones(count, dtype=np.bool_)
        for place in likely[np.argsort(-gains[likely])].tolist():
            k = place % count
            if free[k]:
                places.append(place)
                free[max(k - reach + 1, 0):k + reach] = False
        self._open[places] = False
        for k in (place % count for place in places if place // count == UNKNOWN):
            self._commands[UNKNOWN, k] = leads[k] if leads[k] > held[k] else leads[k] - self._gap
        return np.array(sorted(places, key=lambda place: place % count), dtype=np.intp)

    @staticmethod
    def _against(now: _Choice) -> Array:
        """Log-likelihood that each place has to gain."""
        against = LOG_ODDS[now.row] - LOG_ODDS[:, None]
        return np.append(against.ravel(), np.full(len(now.row), -SURPRISE))

    def exchanged(self, now: _Choice, places: Places) -> _Choice:
        """The same but for these places."""
        row, outliers, count = now.row.copy(), now.outliers.copy(), len(now.row)
        of_commands = places < self._commands.size
        commands, readings = places[of_commands], places[~of_commands]
        row[commands % count], outliers[readings % count] = commands // count, True
        return _Choice(row, outliers)

    def refused(self, now: _Choice, places: Places, here: _Place, after: Array) -> Places:
        """Those of these places at which e became no smaller by so much as was expected."""
        e, count, reach = here.e, len(after), len(self._whitening.signatures[0])
        begins = places % count
        ends = np.minimum(begins + reach, np.append(begins[1:], count))
        less = np.append(0.0, np.cumsum(0.5 * (e**2 - after**2) / here.noise_std**2))
        return np.asarray(places[less[ends] - less[begins] <= self._against(now)[places]])


def _ahead(values: Array, signature: Array) -> Array:
    """Sum of the signature (L,) times the values (N,) from each of them on, shape (N,)."""
    longer = np.append(values, np.zeros(len(signature) - 1))
    return np.correlate(longer, signature, 'valid')
