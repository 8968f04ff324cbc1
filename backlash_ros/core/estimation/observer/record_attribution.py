"""Which commands of a record acted, and which readings are outliers, by all y that came after.

Where another command acted over an interval, u was another one until the play output is the same
again, and y moves by what G makes of that. An outlier moves one y alone. Both leave a signature s
in the innovations e of the fit, whitened as by an observer:

    gain in log-likelihood = (s.e - s.s / 2) / sigma^2         another command: s is known
                             (s.e)^2 / (2 s.s sigma^2)         an outlier: its size is free

Where that is more than the odds against it, and remains so once all follows from it, it is
believed; the largest first, until there is none. sigma is told by the median of |e|: what is looked
for does not widen it.

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
from scipy.signal import lfilter

from backlash_ros.core.estimation.constants import GATE, ODDS
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.fit.window_fit import NO_RESIDUAL
from backlash_ros.core.estimation.observer.observer import RATIOS, gain_of
from backlash_ros.core.estimation.regression.play import play
from backlash_ros.core.estimation.regression.residuals import bulk_std
from backlash_ros.core.estimation.regression.resolution import resolution_of
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Places = NDArray[np.intp]

AGAINST_ANOTHER = log(ODDS)  # log-likelihood that the other command has to gain
AGAINST_AN_OUTLIER = 0.5 * GATE**2  # log-likelihood that an outlier has to gain
WHITE = RATIOS[len(RATIOS) // 2]  # noise on u that innovations are whitened for
FILLED = 3  # times that lost outputs are replaced by what was expected: those in a row


class Attributed(NamedTuple):
    """v (N,) that acted over a record, and which y (N,) are outliers."""

    v: Array
    outliers: Flags


def with_other_commands(
    result: Fitted, v: Array, y: Array, other: Array, around: Around, pace: Pace,
) -> Generator[None, None, tuple[Fitted, Attributed]]:
    """The fit around this with the commands that another one says have acted, and these.

    result: fit of v (N,) and y (N,) that says so; it stays where it says nothing. other: see
    `attributed`.
    """
    found = yield from attributed(result, v, y, other)
    if not found.outliers.any() and np.array_equal(found.v, v):
        return result, found
    start, slope = result.beginning(found.v), result.solution.m
    known = np.where(found.outliers, np.nan, y)
    return (yield from fitted(found.v, known, around, start, slope, pace)), found


def attributed(
    result: Fitted, v: Array, y: Array, other: Array,
) -> Generator[None, None, Attributed]:
    """What a fit says of v (N,) and y (N,), nan where lost, that it has taken in or refused.

    Stops between its steps. other: commands that may have acted instead (N,), nan where none may;
    where there is none at all, it says nothing.
    """
    now = Attributed(v, np.zeros(len(v), dtype=np.bool_))
    if not (np.isfinite(other).any() and np.isfinite(y).any()):
        return now
    model = result.fit.model
    gain = gain_of(model, WHITE)
    if result.solution.crossings is None or gain is None:
        return now
    yield
    search = _Search(result, _Whitening(model, gain.gain), v, y, other)
    here = search.beginning
    while True:
        yield
        places = search.likely(now, here)
        if not len(places):
            return now
        yield
        before, now = here, search.exchanged(now, places)
        here = search.at(now)
        refused = search.refused(places, before.e, here.e)
        if len(refused):
            yield
            now = search.exchanged(now, refused)
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
    """Play output (N,) and innovations (N,) in units of their deviation, for some commands."""

    p: Array
    e: Array


class _Search:
    """Looks for places where another command acted, or where y is an outlier.

    Numbers below N stand for commands, from N on for readings. beginning: what follows from those
    that were told.
    """

    def __init__(
        self, result: Fitted, whitening: _Whitening, v: Array, y: Array, other: Array,
    ) -> None:
        fit, solution, _ = result
        self._whitening, self._gap, self._p0 = whitening, solution.gap, solution.start
        self._m, self._v, self._other = solution.m, v, other
        self._known = np.isfinite(y)
        residual = fit.samples.unweighted_residual(solution.posterior, y)
        self._residual = np.where(self._known, residual, 0.0)
        self._told = play(v, self._gap, self._p0)[0]
        self._open: Flags = np.concatenate([np.isfinite(other), self._known])
        e = whitening.innovations(self._residual, np.zeros(len(v)), self._known)
        self._noise_std = max(
            bulk_std(e[self._known]), resolution_of(y) / sqrt(12.0), NO_RESIDUAL * fit.extent[0]
        )
        self.beginning = _Place(self._told, e / self._noise_std)

    def at(self, of: Attributed) -> _Place:
        """What follows from these commands and outliers."""
        p = play(of.v, self._gap, self._p0)[0]
        change, known = self._m * (p - self._told), self._known & ~of.outliers
        return _Place(
            p, self._whitening.innovations(self._residual, change, known) / self._noise_std
        )

    def likely(self, now: Attributed, here: _Place) -> Places:
        """Places where that is likely, no two so close that one tells of the other."""
        (p, e), (of_u, of_y) = here, self._whitening.signatures
        # Without what the play output remembers of it: `refused` looks at that as well.
        there = np.clip(np.append(self._p0, p[:-1]), self._other, self._other + self._gap)
        move = (there - p) * (self._m / self._noise_std)
        seen = (self._known & ~now.outliers).astype(np.float64)
        gains = np.concatenate([
            move * _ahead(e, of_u) - 0.5 * move**2 * _ahead(seen, of_u**2) - AGAINST_ANOTHER,
            0.5 * _ahead(e, of_y)**2 / float(of_y @ of_y) - AGAINST_AN_OUTLIER,
        ])
        likely = np.flatnonzero(self._open & (gains > 0.0))
        places: list[int] = []
        free, count, reach = np.ones(len(e), dtype=np.bool_), len(e), len(of_u)
        for place in likely[np.argsort(-gains[likely])].tolist():
            k = place % count
            if free[k]:
                places.append(place)
                free[max(k - reach + 1, 0):k + reach] = False
        self._open[places] = False
        return np.array(sorted(places, key=lambda place: place % count), dtype=np.intp)

    def exchanged(self, now: Attributed, places: Places) -> Attributed:
        """The same but for these places, where it is the other way round."""
        v, outliers, count = now.v.copy(), now.outliers.copy(), len(now.v)
        commands, readings = places[places < count], places[places >= count] - count
        told, other = self._v[commands], self._other[commands]
        v[commands] = np.where(v[commands] == told, other, told)
        outliers[readings] ^= True
        return Attributed(v, outliers)

    def refused(self, places: Places, e: Array, after: Array) -> Places:
        """Those of these places at which e became no smaller by so much as was expected."""
        count, reach = len(e), len(self._whitening.signatures[0])
        begins = places % count
        ends = np.minimum(begins + reach, np.append(begins[1:], count))
        less = np.append(0.0, np.cumsum(0.5 * (e**2 - after**2)))
        against = np.where(places < count, AGAINST_ANOTHER, AGAINST_AN_OUTLIER)
        return np.asarray(places[less[ends] - less[begins] <= against])


def _ahead(values: Array, signature: Array) -> Array:
    """Sum of the signature (L,) times the values (N,) from each of them on, shape (N,)."""
    longer = np.append(values, np.zeros(len(signature) - 1))
    return np.correlate(longer, signature, 'valid')
