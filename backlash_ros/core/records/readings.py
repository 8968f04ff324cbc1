"""What readings of y tell before any fit: which are invalid, how noisy and how smooth they are.

Repetitions, failed reads and lost turns are recognised if nothing else explains them. A smooth
motion is predicted from its neighbours: the error is noise, and wrong instants increase it.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from backlash_ros.core.estimation.settings import GATE, OUTLIER_SHARE
from backlash_ros.core.plant.quantized import step_of
from backlash_ros.core.plant.transfer_function import Array

Flags = NDArray[np.bool_]

NEARLY_ALL = 0.9  # least share of cases that has to agree with an explanation
SEARCHED_AT_MOST = 6000  # samples of a record in which the gap is searched for
FEWEST_VALUES = 20  # of a signal, to tell how rough it is
TO_STD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation


def quantum(y: Array) -> float:
    """Quantization step of y (N,), 0 if it is not quantised."""
    return _repeated_step(y) or step_of(y)


def _repeated_step(y: Array) -> float:
    """The same, of readings that repeat, even in a file of few digits; 0 if they do not."""
    values = np.unique(y[np.isfinite(y)])
    if len(values) < 2 or len(values) > 0.8 * len(y):
        return 0.0
    steps = np.diff(values)
    steps[steps <= 1e-9 * (values[-1] - values[0])] = 0.0
    # Counted from value to value, as a file may have fewer digits than the step.
    numbers = np.append(0.0, np.cumsum(np.round(steps / steps[steps > 0.0].min())))
    step = float((values[-1] - values[0]) / numbers[-1])
    return step if np.abs((values - values[0]) / step - numbers).max() < 0.05 else 0.0


def own_readings(t: Array, y: Array) -> tuple[Flags, float]:
    """Rows (N,) in which y is a reading of its own, and the period [s] of the sensor if it is
    slower than the rows, else 0. t (N,): instants [s], rising.

    A y that moves by several steps per reading changes in every row, unless rows repeat it. At rest
    a reading looks like its repetition, so one row per period is taken.
    """
    fewest_changes = 12  # changes of y, beyond all rounding, needed to tell a slower sensor
    known = np.flatnonzero(np.isfinite(y))
    every = np.isfinite(y), 0.0
    values, times = y[known], t[known]
    moves = np.diff(values)
    changed = np.flatnonzero(moves != 0.0) + 1
    if not fewest_changes <= len(changed) <= 0.7 * len(values):
        return every
    clear = np.abs(moves[changed - 1]) >= 3.0 * (quantum(values) or 1e-9 * np.ptp(values))
    inner = changed[clear & (changed > 1) & (changed < len(values) - 1)]
    alone = (moves[inner - 2] == 0.0) & (moves[inner] == 0.0)
    if len(inner) < fewest_changes or np.mean(alone) < NEARLY_ALL:
        return every
    # During a motion: the time from each clear change back to the change before it, clear or not.
    since = np.diff(times[changed], prepend=np.nan)[np.isin(changed, inner)]
    low, period, high = np.nanpercentile(since, [15.0, 50.0, 85.0]).tolist()
    if not high - low <= period:
        return every
    begins, ends = np.append(0, changed), np.append(changed, len(times))
    until = np.append(times[changed], times[-1] + period)
    counts = np.maximum(((until - times[begins]) / period + 0.5).astype(int), 1)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    at = np.searchsorted(times, np.repeat(times[begins], counts) + period * (number - 1e-9))
    own = np.zeros(len(y), dtype=bool)
    own[known[at[at < np.repeat(ends, counts)]]] = True
    return own, float(period)


def failed(y: Array) -> tuple[Flags, float]:
    """Flags (N,) of reads that failed, and the value that they have: 0, or the largest or smallest
    of all, which occurs once or twice in a row, far from both neighbours."""
    known = np.flatnonzero(np.isfinite(y))
    values = y[known]
    rows = np.zeros(len(y), dtype=bool)
    for value in (0.0, float(values.min()), float(values.max())) if len(known) >= 10 else ():
        at = values == value
        if not 3 <= np.count_nonzero(at) <= 0.5 * len(values):
            continue
        edges = np.diff(np.concatenate([[0], at.astype(int), [0]]))
        runs = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
        others = np.flatnonzero(~at)
        between = np.interp(np.flatnonzero(at), others, values[others])
        # How far a motion goes from one true reading to the next.
        usual = float(np.percentile(np.abs(np.diff(values[others])), 75.0))
        far = np.abs(between - value) > 6.0 * max(usual, 1e-9 * float(np.ptp(values)))
        if np.mean(runs <= 2) >= NEARLY_ALL and np.mean(far) >= 0.5:
            rows[known[at]] = True
            return rows, value
    return rows, 0.0


def unwrapped(values: Array) -> tuple[Array, float]:
    """The values (N,) without the jumps of an angle that wraps around, and its turn, 0 if none.

    The values span one turn, no more, and all large jumps are turns against the motion around them.
    """
    turn_tolerance = 0.02  # relative error of the jump of an angle that wraps around
    # Degrees, radians, gradians, steps of encoders.
    turns = (360.0, 2.0 * np.pi, 400.0, 6400.0, 3600.0, *(2.0**n for n in range(8, 33)))
    known = np.isfinite(values)
    if known.sum() < 10:
        return values, 0.0
    steps, reach = np.diff(values[known]), float(np.ptp(values[known]))
    usual = float(np.percentile(np.abs(steps), 95.0))
    for turn in turns:
        jumps = np.abs(steps) > 0.6 * turn  # too far for a motion
        fills = 0.9 * turn <= reach <= (1.0 + turn_tolerance) * turn
        if not fills or not jumps.any() or usual > 0.1 * turn:
            continue
        off = np.abs(np.abs(steps[jumps]) - turn)
        motion = np.convolve(np.where(jumps, 0.0, steps), np.ones(7), mode='same')[jumps]
        if (off <= max(turn_tolerance * turn, 5.0 * usual)).all() and \
                np.mean(motion * np.sign(steps[jumps]) < 0.0) >= 0.8:
            return _without(turn, jumps, values), turn
    return values, 0.0


def _without(turn: float, jumps: Flags, values: Array) -> Array:
    known, out = np.isfinite(values), values.copy()
    turns = np.where(jumps, turn * np.sign(np.diff(values[known])), 0.0)
    out[known] -= np.append(0.0, np.cumsum(turns))
    return out


def without_slips(y: Array, v: Array) -> tuple[Array, float]:
    """y (N,) without rare jumps by a turn that v (N,) does not make, and that turn, 0 if none."""
    known = np.flatnonzero(np.isfinite(y))
    steps = np.diff(y[known])
    if len(steps) < 20:  # too few to recognise a jump
        return y, 0.0
    usual = 3.0 * float(np.percentile(np.abs(steps), 95.0))
    jumps = np.abs(steps) > 10.0 * usual
    moves = np.abs(np.diff(v, prepend=v[0]))
    lively = 3.0 * float(np.percentile(moves, 95.0))
    for turn in (2.0 * np.pi, 360.0) if 0 < jumps.sum() <= 0.01 * len(steps) else ():
        whole = np.abs(np.abs(steps[jumps]) - turn) <= usual + 1e-3 * turn
        alone = (moves[max(known[k] - 50, 0):known[k + 1] + 5].max() <= lively
                 for k in np.flatnonzero(jumps))
        if whole.all() and all(alone):
            return _without(turn, jumps, y), turn
    return y, 0.0


def check_record(v: Array, y: Array) -> None:
    """Raise ValueError unless v (N,) is finite and y (N,) is finite, or nan where it was lost."""
    if v.ndim != 1 or v.shape != y.shape:
        raise ValueError(f'v {v.shape} and y {y.shape} must be of one length')
    if not np.isfinite(v).all():
        raise ValueError('v must be finite in every sample')
    if np.isinf(y).any():
        raise ValueError('y must be finite, or nan where it was lost')


def busiest(v: Array, y: Array) -> slice:
    """The stretch of a record to search, in which v (N,) moves most while y (N,) is known."""
    if len(v) <= SEARCHED_AT_MOST:
        return slice(0, len(v))
    path = np.append(0.0, np.cumsum(np.abs(np.diff(v)) * np.isfinite(y[1:])))
    first = int(np.argmax(path[SEARCHED_AT_MOST - 1:] - path[:len(v) - SEARCHED_AT_MOST + 1]))
    return slice(first, first + SEARCHED_AT_MOST)


def outliers(residual: Array, least_std: float) -> Flags:
    """Flags (N,) of outliers in a residual (N,), nan where y is lost; no flags if there are too
    many to be outliers. least_std: the standard deviation of the others is at least that."""
    size = np.abs(residual)
    known = size[np.isfinite(size)]
    typical = TO_STD * float(np.median(known)) if len(known) else 0.0
    wild = size > GATE * max(typical, least_std)
    return wild if np.count_nonzero(wild) <= OUTLIER_SHARE * len(known) else np.zeros_like(wild)


def frequencies_of(y: Array) -> tuple[float, float]:
    """Lowest and highest frequency [rad/sample] of the motion of y (N,), nan where lost."""
    motion = (0.1, 0.9)  # share of the power of the moves of y that lies below each of them
    known = np.flatnonzero(np.isfinite(y))
    moves = np.diff(np.interp(np.arange(len(y)), known, y[known]))
    power = np.abs(np.fft.rfft((moves - moves.mean()) * np.hanning(len(moves)))) ** 2
    total = np.cumsum(power)
    low, high = np.searchsorted(total, np.array(motion) * total[-1]) * (2.0 * np.pi / len(moves))
    return float(low), float(high)


def _residuals(t: Array, s: Array, reach: int) -> Array:
    """Error of predicting values from `reach` neighbours on each side, scaled as the noise is."""
    if len(s) < FEWEST_VALUES:
        return np.empty(0)
    times, values = (sliding_window_view(each, 2 * reach + 1) for each in (t - t[0], s))
    # Neighbours at nearly the same instant predict nothing.
    apart = np.diff(times, axis=1).min(axis=1) > 0.05 * np.ptp(t) / (len(t) - 1)
    times, values = times[apart], values[apart]
    # Of a divided difference, which is 0 if all values are equal.
    weights = np.stack([1.0 / np.prod(times[:, [j]] - np.delete(times, j, axis=1), axis=1)
                        for j in range(2 * reach + 1)], axis=1)
    off = values - values[:, [reach]]
    return np.asarray(np.sum(weights * off, axis=1) / np.linalg.norm(weights, axis=1))


def noise_of(t: Array, y: Array) -> float:
    """Standard deviation of the noise of a finite y (N,) at t (N,), by cubic prediction, or 0."""
    errors = np.abs(_residuals(t, y, 2))
    return TO_STD * float(np.median(errors)) if len(errors) else 0.0


def curvature_of(t: Array, y: Array, noise: float) -> float:
    """Rms error, beyond the noise, of interpolating y (N,) linearly midway between neighbours."""
    errors = _residuals(t, y, 1)
    # The variance of a linear prediction from both sides is 1 + 1/2 that of the noise, and its
    # neighbours are twice as far apart as those of the line, which makes four times the error.
    square = 1.5 * (float(np.mean(errors**2)) - noise**2) if len(errors) else 0.0
    return 0.25 * float(np.sqrt(max(square, 0.0)))


def rougher(t: Array, other: Array, signal: Array) -> float:
    """Log of how much rougher a signal (N,) is over instants t (N,) than over `other` (N,)."""
    known, sizes = np.isfinite(signal), []
    for instants in (t, other):
        squares = _residuals(instants[known], signal[known], 1)**2
        if len(squares) < FEWEST_VALUES:
            return 0.0
        # Jumps, which are as rough over any instants, are limited.
        sizes.append(float(np.mean(np.minimum(squares, np.percentile(squares, 98.0)))))
    return 0.5 * float(np.log(sizes[0] / sizes[1])) if min(sizes) > 0.0 else 0.0
