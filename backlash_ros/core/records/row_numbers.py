"""Number the rows of a log by their stamps, which may jitter or be late, and where rows may miss.

    t(k) = b + P n(k) + P e(k),   n(k) = k + c(k),   c(k) >= c(k-1)

`likeliest`: the jitter e is Laplace-distributed, and c rises with probability q. For given P and b,
c is found by dynamic programming, and P and b from it in turn. A shorter P explains any stamps with
more missing rows: what decides is the length of the whole description, of jitter and missing rows
(J. Rissanen, Modeling by shortest data description, Automatica 14 (1978) 465-471).
"""

from math import inf, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.loop.sample_counter import JITTER, numbered
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.records.stamps import fewest_digits

Numbers = NDArray[np.int64]

REACH = 2  # samples by which a number may differ from what its own stamp says
FINEST = 1e-3  # mean jitter below which there is none [periods]
FIRST, ENOUGH = 100, 1000  # rows by which all periods are compared, and then the best few of them
FEW, APART = 5, 0.3  # how many these are, and the distance of the first ones [samples over FIRST]


class Numbering(NamedTuple):
    """Numbers of rows (M,) from 0, whose stamps are begin + period * numbers + off [s]."""

    numbers: Numbers
    period: float
    begin: float
    off: Array


def along(numbers: Numbers, t: Array) -> Numbering:
    """These numbers of rows with stamps t (M,) [s], and the line through them; its period has as
    few digits as its standard deviation allows."""
    period, begin = np.polyfit(numbers, t, 1).tolist()
    off = t - begin - period * numbers
    deviation = max(2.0 * float(np.std(off)), 1e-12 * period) / float(numbers[-1])
    return Numbering(numbers, fewest_digits(period, deviation), begin, off)


def even(t: Array, period: float) -> Numbering:
    """Of rows with stamps t (M,) [s] without jitter; the period [s] need not be exact."""
    return along(_risen(np.append(0.0, np.cumsum(np.round(np.diff(t) / period)))), t)


def late(t: Array, period: float) -> Numbering:
    """Of rows with stamps t (M,) [s] that may be late, never early."""
    return along(_risen(np.array(numbered((t / period).tolist(), 1.0, 1.0 - JITTER))), t)


def _risen(numbers: Array) -> Numbers:
    """The numbers made to rise strictly, by lowering those before the last of a heap, from 0."""
    place = np.arange(len(numbers))
    risen = np.minimum.accumulate((numbers - place)[::-1])[::-1] + place
    return np.asarray(risen - risen[0], dtype=np.int64)


class Description(NamedTuple):
    """Numbers of rows, P and b [s], the mean of |e|, q, and the length of all that [nats]."""

    numbers: Numbers
    period: float
    begin: float
    jitter: float = 0.25
    missing: float = 0.05
    length: float = inf


def likeliest(t: Array, shortest: float, longest: float) -> Numbering:
    """Of rows with rising stamps t (M,) [s] that jitter; bounds of the period [s].

    Begins with few rows, and takes more until all are numbered.
    """
    count = min(FIRST, len(t))
    periods = np.geomspace(longest, shortest, 2 + int(count / APART * log(longest / shortest)))
    begun = [Description(np.arange(0), period, float(t[0])) for period in periods.tolist()]
    while True:
        found = {each.numbers.tobytes(): each for each in (
            _refined(t[:count], each, shortest, longest) for each in begun)}
        begun = sorted(found.values(), key=lambda each: each.length)
        if count == len(t):
            return along(begun[0].numbers, t)
        best, few = begun[0], count < ENOUGH
        # One or two samples more or less may be missing: that is another optimum.
        begun = begun[:FEW if few else 1] + [
            best._replace(period=best.period * (1.0 + more / count))
            for more in (-2.0, -1.0, 1.0, 2.0) if few]
        count = min((2 if few else 8) * count, len(t))


def _refined(t: Array, start: Description, shortest: float, longest: float) -> Description:
    """Alternate between the numbers and all else while that shortens the description."""
    place, best = np.arange(len(t)), start._replace(length=inf)
    _, period, begin, jitter, missing, _ = start
    for _ in range(4):
        due = (t - begin) / period - place
        numbers = place + _rising(due, jitter, log(1.0 / missing - 1.0))
        period = min(max(float(np.polyfit(numbers, t, 1)[0]), shortest), longest)
        begin = float(np.median(t - period * numbers))
        jitter = max(float(np.abs((t - begin) / period - numbers).mean()), FINEST)
        rises = int(np.count_nonzero(np.diff(numbers) > 1))
        missing = (rises + 1.0) / (len(t) + 2.0)
        length = len(t) * log(jitter / (1.0 - missing)) + rises * log(1.0 / missing - 1.0)
        if not length < best.length:
            break
        first = int(numbers[0])
        best = Description(
            numbers - first, period, begin + period * first, jitter, missing, length)
    return best


def _rising(due: Array, jitter: float, cost_of_rise: float) -> Numbers:
    """Whole numbers c (M,) that never fall and minimize sum |due - c| / jitter + costs of rises."""
    # c of a row cannot lie far above what any later row is due.
    base = np.minimum.accumulate(np.floor(due)[::-1])[::-1].astype(np.int64) - REACH + 1
    width = 2 * REACH + 1
    costs = np.abs(due[:, None] - base[:, None] - np.arange(width)) / jitter
    value, came_from = costs[0].tolist(), [[0] * width]
    for row, shift in zip(costs[1:].tolist(), np.diff(base).tolist(), strict=True):
        lowest, lowest_at, below = inf, 0, 0  # the best c that is lower
        new, origins = list[float](), list[int]()
        for same, cost in enumerate(row, start=shift):  # same: where this c was at the row before
            while below < min(same, width):
                if value[below] < lowest:
                    lowest, lowest_at = value[below], below
                below += 1
            stays = same < width and value[same] <= lowest + cost_of_rise
            new.append(cost + (value[same] if stays else lowest + cost_of_rise))
            origins.append(same if stays else lowest_at)
        value = new
        came_from.append(origins)
    at, states = min(range(width), key=value.__getitem__), list[int]()
    for origins in reversed(came_from):
        states.append(at)
        at = origins[at]
    return np.asarray(base + np.array(states[::-1]))
