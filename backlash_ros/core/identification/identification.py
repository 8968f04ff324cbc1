"""From v and y to backlash, G(z), delay and noise, with deviations and all that keeps them apart.

    the best structure (structure_search.py)  ->  a fit of the whole record
    ->  deviations, verdict (description.py)

Search and fit are those of the loop, for plants without a prior (structure.py).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from math import log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.fit import FIRST_STEPS
from backlash_ros.core.identification.description import as_a_gain, described
from backlash_ros.core.identification.order_selection import PLATEAU, effective, equal_delays
from backlash_ros.core.identification.response import least_response
from backlash_ros.core.identification.result import Identification, Options
from backlash_ros.core.identification.structure import TINY, Structure, fitted, moved_to
from backlash_ros.core.identification.structure_search import (
    EARLY,
    POLES,
    Units,
    begun,
    later,
    searched,
    without_outliers,
)
from backlash_ros.core.records.samples import busiest, check_record

Array = NDArray[np.float64]

def identify(v: Array, y: Array, sample_period: float, options: Options | None = None,
             ) -> Identification:
    """Identify v (N,), applied from k to k+1, and y (N,) at k, nan where lost.

    Raises ValueError for arrays that do not fit together or hold what is no number.
    """
    work = identifying(v, y, sample_period, options or Options())
    while True:
        try:
            next(work)
        except StopIteration as done:
            found: Identification = done.value
            return found


def identifying(
    v: Array, y: Array, sample_period: float, options: Options,
) -> Generator[str, None, Identification]:
    """The same; yields what is being done."""
    v, y = np.asarray(v, dtype=float), np.asarray(y, dtype=float)
    check_record(v, y)
    given, part = Identification(sample_period, v, y), busiest(v, y)
    nothing = _why_nothing(v, y[part], options)
    if nothing:
        return replace(given, reasons=(nothing,))
    units = Units(float(v.mean()), float(np.ptp(v[part])), float(np.nanmedian(y)),
                   float(np.nanstd(y[part])))
    v, y = (v - units.v) / units.v_size, (y - units.y) / units.y_size
    s = yield from searched(v[part], y[part], options, options.delays or EARLY)
    if not options.delays:
        s = yield from later(s, options)
    yield 'choosing the delay'
    best, rows = s.best, effective(s.best.left)
    others = [
        fitted(s.samples, structure, moved_to(structure, best))
        for delay in equal_delays(s.compared, s.chosen) if delay != best.structure.delay
        for structure in [replace(best.structure, delay=delay)]
    ]
    # With as many poles, some of them may fit worse.
    best, beside = least_response(s.samples, best, [
        one for one in others if rows * log(max(one.squares, TINY) / max(best.squares, TINY))
        <= PLATEAU
    ], best.squares / rows)
    samples = s.samples
    if len(v) > len(samples.v):
        yield 'fitting the whole record'
        whole = y.copy()
        whole[part] = samples.y
        samples = replace(samples, v=v, y=whole, last=len(v))
        begin = moved_to(best.structure, best, p0=float(v[0]) + 0.5 * best.gap)
        best = begun(fitted(samples, best.structure, begin, FIRST_STEPS, beside))
        kept = without_outliers(samples, best)
        if kept is not samples:
            samples = kept
            best = fitted(samples, best.structure, best.fit, beside=beside)
    yield 'judging'
    given = replace(given, outliers=int((np.isfinite(given.y) & np.isnan(samples.y)).sum()))
    s = s._replace(samples=samples, best=best, held_out=s.held_out._replace(
        first=part.start + s.held_out.first))
    found = described(s, given, options, units)
    return as_a_gain(found, s, given, options, units)


def _why_nothing(v: Array, y: Array, options: Options) -> str:
    """Why there is nothing to fit; empty where there is. y: of the part that is searched."""
    known = np.isfinite(y[max(options.delays or EARLY) + 1:])
    # The first samples of them are fitted alone, to predict the others.
    fitted = known[:len(known) - round(options.held_out * len(known))]
    needed = 8 * max(Structure(max(options.orders), 0, False).unknowns,
                          Structure(POLES, 0, False).unknowns)
    if fitted.sum() < needed or not known[len(fitted):].any():
        return (
            f'{int(known.sum())} samples of y are too few, or lie too unevenly, for an order of up '
            f'to {max(options.orders)}, about {round(needed / (1.0 - options.held_out))} are '
            'needed: record for longer, or limit --order'
        )
    if np.ptp(v) == 0.0:
        return 'v stood still: move it to and fro, past the gap'
    if np.nanmax(y) == np.nanmin(y):
        return 'y stood still: let v swing wider than the gap, and see that y is measured'
    return ''
