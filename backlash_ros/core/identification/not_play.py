"""What is not a play, or not that alone, named by what it is: one test for each, from data alone.

Every test asks one thing of v, y, the play output p that was fitted and the y simulated from it.
The nonlinearities that could stand in place of a play are compared with it through one and the same
general linear family (a few taps, lags of several lengths, an integral, an offset, a drift), which
is solved for exactly, so that none of them depends on the G that was fitted with a play.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.play import LEFT, engaged, play
from backlash_ros.core.plant.filtering import lfilter

Array = NDArray[np.float64]

LONGEST = 4000  # samples that are looked at
ROWS = 1500  # of them that are fitted
BEGIN = 100  # samples at most that are left out at the begin
TAPS, LAGS = 3, (0.7, 2.0, 6.0, 20.0, 60.0)  # of the linear family [samples]
BEYOND_NOISE = 1.5  # times the noise: a residual as small as this leaves nothing to name
LITTLE = 1e-3  # of the swing of y, likewise
SURE = 15.0  # log-likelihood by which another nonlinearity must beat a play
EXPLAINED = 0.9  # share of what a play leaves beyond the noise, likewise
EVALUATIONS = 50  # of a search from one start
WIDTHS = (0.0006, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.6, 0.8)  # of the swing of v
TURNS = 3  # of a search for several plays, from a system behind them that is one of these columns
STARTS = (0, TAPS + 1, TAPS + 2, TAPS + 3)  # columns
PLAYS, WIDEST = 12, 0.7  # in parallel, and the widest of them, in swings of v
SEVERAL = 0.2  # of the largest weight: a play in parallel that counts
LEAD = 0.002  # of the swing of v: a lead where v turns
LEADS = 0.6  # share of what a play leaves, that a lead where v turns has to explain
SMOOTH = 0.6  # share of what a play leaves, that several plays have to explain
FEWEST = 20  # moves that are looked at
MOVED = 8.0  # noises by which y should have moved, to see whether it stuck
STUCK_SHARE, JUMPED = 0.35, 2.0  # of such moves; times what y should have moved
JUMPED_SHARE = 0.04  # of such moves
REST = 8  # samples of v at rest, behind as many in which y settles
PUSHED, PUSHED_SHARE = 5.0, 0.02  # noises, and share of the swing of y
FLAT, GOES_ON = 0.12, 0.15  # shares of the swings of y and v: y at its end, while v goes on
AT_END = 0.15  # share of the time that y is at its end
BADLY = 0.05  # of the swing of y, that the fit leaves
ALONG = 0.3  # correlation of v and y
CREEP = 0.3  # of the swing of y over the record
CLEAR = 0.003  # of the swing of v: a gap that is one
COASTS = 2.0  # ratio of the residual while v crosses the gap to that while it is engaged


class Observed(NamedTuple):
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
        return left > max(BEYOND_NOISE * self.noise, LITTLE * self.swing)


def what_it_is(o: Observed) -> list[str]:
    """What else than one play y shows, a sentence each; nothing where a play explains it."""
    if not o.unexplained:
        return []
    # Each of them would look like one of those below it as well.
    for test in (saturation, pushed, creep, other_nonlinearity, stick_slip):
        said = test(o)
        if said:
            return [said]
    return [said for said in (coasting(o),) if said]


def saturation(o: Observed) -> str:
    """Play, then a y that goes on no further while v does."""
    known = np.flatnonzero(np.isfinite(o.y))
    y, v = o.y[known], o.v[known]
    bottom, top = np.percentile(y, [3.0, 97.0]).tolist()
    along = float(np.corrcoef(v, y)[0, 1]) if np.ptp(v) > 0.0 and top > bottom else 0.0
    # Of a G that integrates, y is at its end where v is in its middle.
    left = float(np.sqrt(np.nanmean(o.residual**2)))
    if abs(along) < ALONG or left < BADLY * (top - bottom):
        return ''
    on: list[float] = []
    at_end = 0
    for end, way in ((top, along), (bottom, -along)):
        runs = [(a, b) for a, b in _stretches(np.abs(y - end) < FLAT * (top - bottom)) if b - a > 4]
        of_side = [float(np.max((v[a:b + 1] - v[a]) * np.sign(way))) for a, b in runs]
        on += of_side
        at_end += sum(b - a for a, b in runs)
        for beyond in (of_side, on):
            far = [size for size in beyond if size > GOES_ON * np.ptp(v)]
            if len(far) >= 4 and len(far) > 0.5 * len(beyond) and at_end > AT_END * len(y):
                return (
                    f'y stays at about {end:.4g} while v goes on by {np.median(far):.3g} and more: '
                    'the sensor is at its end, or the load slides there; move v less far'
                )
    return ''


def pushed(o: Observed) -> str:
    """A y that moves while v is at rest."""
    at_rest = np.append(False, np.diff(o.v) == 0.0) & np.append(False, np.diff(o.p) == 0.0)
    moved = []
    for a, b in _stretches(at_rest):
        part = o.residual[a + REST:b + 1]
        part = part[np.isfinite(part)]
        if len(part) >= REST:
            moved.append(float(np.ptp(part)))
    # Of white noise, the range of a few dozen readings is some four deviations.
    least = max(PUSHED * o.noise, PUSHED_SHARE * o.swing)
    clear = [size for size in moved if size > least]
    if len(clear) < max(2.0, 0.2 * len(moved)):
        return ''
    return (
        f'y moves by up to {max(clear):.3g} while v is at rest: something else moves the load; '
        'hold it, or keep it free'
    )


def stick_slip(o: Observed) -> str:
    """A y that stays where it should move, and then jumps."""
    engaged = np.isfinite(o.y) & np.append(False, np.diff(o.p) != 0.0)
    known = np.flatnonzero(engaged)
    if len(known) < 3 * FEWEST:
        return ''
    sim, y = o.simulated[known], o.y[known]
    # From each reading to the one by which y should have moved clearly.
    path = np.append(0.0, np.cumsum(np.abs(np.diff(sim))))
    ahead = np.searchsorted(path, path + MOVED * o.noise)
    begin = np.flatnonzero(ahead < len(y))
    should, did = sim[ahead[begin]] - sim[begin], y[ahead[begin]] - y[begin]
    clear = np.abs(should) > 0.5 * MOVED * o.noise
    if np.count_nonzero(clear) < FEWEST:
        return ''
    share = did[clear] / should[clear]
    stuck, jumped = float(np.mean(np.abs(share) < 0.3)), float(np.mean(share > JUMPED))
    if stuck < STUCK_SHARE or jumped < JUMPED_SHARE:
        return ''
    return (
        f'y sticks and slips: it stays for {stuck:.0%} of the time in which it should move, and '
        f'goes on in jumps of up to {np.percentile(np.abs(np.diff(y)), 99.0):.2g}: friction; '
        'loosen it, or move faster'
    )


def other_nonlinearity(o: Observed) -> str:
    """A dead zone, a drive that compensates already, or several plays in parallel."""
    part = slice(0, min(len(o.v), LONGEST))
    fit = _Family(o.v[part], o.y[part])
    swing = float(np.ptp(fit.v))
    if swing == 0.0 or len(fit.rows) < 100:
        return ''

    def with_play(width: float) -> Array:
        return _played(fit.v, abs(width)) - 0.5 * abs(width)

    widths = [(swing * share,) for share in WIDTHS] + [(o.gap,)]
    one = fit.best(with_play, widths)
    middle = 0.5 * float(fit.v.max() + fit.v.min())
    zone = fit.best(
        lambda centre, half: _dead_zone(fit.v, centre, abs(half)),
        [(middle + swing * a, swing * b) for a in (-0.2, 0.0, 0.2) for b in (0.03, 0.1, 0.2, 0.3)],
    )
    if fit.beats(zone, one, o.noise):
        centre, half = zone.at
        return (
            f'v does nothing from {centre - abs(half):.4g} to {centre + abs(half):.4g}, from '
            'wherever it comes: a dead zone, which has no memory, and no backlash; remove it where '
            'it is made, it is not compensated here'
        )
    width = abs(one.at[0])
    leads = fit.best(lambda width: 2.0 * fit.v - with_play(width), widths)
    if fit.beats(leads, one, o.noise, LEADS) and abs(leads.at[0]) > width + LEAD * swing:
        return (
            f'y leads v by {abs(leads.at[0]):.3g} where v turns: the drive compensates a backlash '
            'already, by too much; switch that off, or leave it to it'
        )
    steps = swing * np.linspace(0.0, WIDEST, PLAYS)
    weights, several = fit.parallel([with_play(width) for width in steps])
    count = int(np.count_nonzero(weights > SEVERAL * weights.max()))
    if count >= 3 and fit.beats(several, one, o.noise, SMOOTH):
        return (
            f'{count} plays in parallel explain it, up to {steps[weights > 0.0].max():.3g} wide: y '
            'turns smoothly, as with friction along the way or in a piezo; only a single backlash '
            'is compensated here'
        )
    return ''


def varies(o: Observed, parts: Sequence[NDArray[np.bool_]]) -> tuple[Array, Array]:
    """The gap in each part of a record (flags (N,) each), and its standard deviation."""
    fit = _Family(o.v, o.y)
    p = _played(o.v, o.gap)
    left = engaged(o.v, p, o.gap) == LEFT
    columns = fit.columns(p)
    _, solution = fit.squares(columns)
    residual = fit.target - np.column_stack([columns, fit.common]) @ solution
    # What y would do if the gap were wider in this part alone.
    by = np.column_stack([
        fit.columns((left - 0.5) * flags) @ solution[:columns.shape[1]] for flags in parts
    ])
    whole = np.column_stack([by, fit.common])
    scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
    scale[scale == 0.0] = np.inf
    inverse = np.linalg.pinv(whole / scale, rcond=1e-8)
    found = inverse @ residual / scale
    after = residual - whole @ found
    lag = max(float(np.corrcoef(after[1:], after[:-1])[0, 1]), 0.0) if len(after) > 2 else 0.0
    variance = float(after @ after) / max(len(after) - whole.shape[1], 1)
    variance *= (1.0 + lag) / max(1.0 - lag, 1e-2)
    std = np.sqrt(variance * np.einsum('ij,ij->i', inverse, inverse)) / scale
    return o.gap + found[:len(parts)], std[:len(parts)]


def creep(o: Observed) -> str:
    """A y that goes away though v returns."""
    fit = _Family(o.v, o.y)
    # Of a G that integrates, y is where it has been driven to.
    columns = fit.columns(o.p)
    left, without = fit.squares(columns[:, :-1])
    # The integral of a p that is not about 0 on the average is a drift of its own.
    solution = min(fit.squares(columns)[1], without, key=lambda one: abs(float(one[-3])))
    by_time = 2.0 * float(solution[-3])
    returning = float(np.ptp(fit.target - solution[-3] * fit.common[:, 1]))
    turns = float(np.abs(np.diff(o.p)).sum()) / (2.0 * max(float(np.ptp(o.p)), 1e-300))
    explained = left < 0.1 * float(np.var(fit.target)) * len(fit.target)
    if not explained or abs(by_time) < CREEP * returning or turns < 3.0:
        return ''
    return (
        f'y creeps by {by_time:.3g} over the record, {by_time / turns:.3g} for each motion to and '
        'fro, though v returns: the way is not the same in both directions, or y drifts; mend what '
        'slips, or measure y without a drift'
    )


def coasting(o: Observed) -> str:
    """A load that goes on while v crosses the gap."""
    if o.gap < CLEAR * float(np.ptp(o.v)):
        return ''
    crossing = np.append(False, (np.diff(o.p) == 0.0) & (np.diff(o.v) != 0.0))
    known = np.isfinite(o.residual)
    within, engaged = known & crossing, known & ~crossing
    if np.count_nonzero(within) < 20 or np.count_nonzero(engaged) < 20:
        return ''
    size = np.sqrt(np.mean(o.residual[within]**2)), np.sqrt(np.mean(o.residual[engaged]**2))
    if size[0] < COASTS * max(float(size[1]), o.noise):
        return ''
    # The way p went before it stopped.
    went = np.sign(np.append(0.0, np.diff(o.p)))
    before = went[np.maximum.accumulate(np.where(went != 0.0, np.arange(len(went)), 0))]
    onwards = float(np.nanmean((o.residual * before)[within])) > 0.5 * float(
        np.nanmean(np.abs(o.residual[within])))
    what = 'it coasts there; brake it, or move more slowly' if onwards else \
        'something else moves it there; hold it, or keep it free'
    return (
        f'while v crosses the gap the load is off by {size[0]:.3g}, and by {size[1]:.3g} while it '
        f'is pushed: {what}'
    )


class _Best(NamedTuple):
    """Squares that a nonlinearity leaves, its parameters, and what it has y follow."""

    squares: float
    at: tuple[float, ...]
    columns: Array


class _Family:
    """Everything linear between the output of a nonlinearity (N,) and y (N,)."""

    def __init__(self, v: Array, y: Array) -> None:
        self.v = v
        # How the motion began nobody knows.
        known = np.flatnonzero(np.isfinite(y) & (np.arange(len(y)) >= min(len(y) // 10, BEGIN)))
        self.rows = known[::max(len(known) // ROWS, 1)]
        self.target = y[self.rows]
        x = np.linspace(-1.0, 1.0, len(v))
        bend = (v - v.mean()) / max(float(np.ptp(v)), 1e-300)
        # A drift, and a characteristic that is not straight.
        self.common = np.column_stack([np.ones(len(v)), x, bend**2, bend**3])[self.rows]

    def columns(self, w: Array, taps: int = TAPS, lags: Sequence[float] = LAGS) -> Array:
        """Taps, lags and the integral of w (N,)."""
        w = w - w.mean()
        found = [np.append(np.full(k, w[0]), w[:len(w) - k]) for k in range(taps)]
        for lag in lags:
            a = float(np.exp(-1.0 / lag))
            found.append(lfilter([1.0 - a], [1.0, -a], w, state=[w[0] * a]))
        found.append(np.cumsum(w))
        return np.column_stack(found)[self.rows]

    def squares(self, columns: Array) -> tuple[float, Array]:
        """What is left over, and the solution (scaled)."""
        whole = np.column_stack([columns, self.common])
        scale = np.sqrt(np.einsum('ij,ij->j', whole, whole))
        scale[scale == 0.0] = 1.0
        solution = np.linalg.lstsq(whole / scale, self.target, rcond=1e-10)[0]
        left = self.target - whole / scale @ solution
        return float(left @ left), solution / scale

    def best(
        self, operator: Callable[..., Array], starts: Sequence[tuple[float, ...]],
    ) -> _Best:
        """The best parameters of a nonlinearity, from the best two starts."""
        from scipy.optimize import minimize  # a fifth of the time that a start takes
        scale = max(float(np.ptp(self.v)), 1e-300)

        def left(at: Sequence[float]) -> float:
            w = operator(*at)
            return self.squares(self.columns(w))[0] if np.ptp(w) > 0.0 else np.inf

        first = sorted((left(at), at) for at in starts)[:2]
        found = first[:1]
        for _, at in first:
            result = minimize(
                lambda x: left(tuple(x * scale)), np.array(at) / scale, method='Nelder-Mead',
                options={'maxfev': EVALUATIONS, 'xatol': 1e-4},
            )
            found.append((float(result.fun), tuple((result.x * scale).tolist())))
        squares, at = min(found)
        return _Best(squares, at, self.columns(operator(*at)))

    def parallel(self, plays: Sequence[Array]) -> tuple[Array, _Best]:
        """Weights, none of them negative, of several plays in parallel, and what is left over."""
        from scipy.optimize import nnls
        columns = [self.columns(w) for w in plays]
        best, weights = _Best(np.inf, (), columns[0]), np.zeros(len(plays))
        # In turn: the weights for a linear system behind them, and that system for the weights.
        # Offset, drift and bend may have any sign.
        free = np.column_stack([self.common, -self.common])
        sign = np.sign(np.corrcoef(self.v[self.rows], self.target)[0, 1])
        for k in range(len(STARTS) * TURNS):
            if k % TURNS == 0:
                linear = sign * np.eye(columns[0].shape[1])[STARTS[k // TURNS]]
            each = np.column_stack([one @ linear for one in columns])
            found = nnls(np.column_stack([each, free]), self.target)[0][:len(plays)]
            if not found.any():
                continue
            summed = np.tensordot(found / found.sum(), columns, axes=1)
            squares, solution = self.squares(summed)
            linear = solution[:summed.shape[1]]
            if squares < best.squares:
                best, weights = _Best(squares, (), summed), found / found.sum()
        return weights, best

    def halves(self, found: _Best) -> Array:
        """Squares left over in either half of the record, fitted alone, shape (2,)."""
        half = len(self.rows) // 2
        whole = np.column_stack([found.columns, self.common])
        left = []
        for part in (slice(0, half), slice(half, None)):
            scale = np.sqrt(np.einsum('ij,ij->j', whole[part], whole[part]))
            columns = whole[part] / np.where(scale > 0.0, scale, 1.0)
            solution = np.linalg.lstsq(columns, self.target[part], rcond=1e-8)[0]
            left.append(float(np.sum((self.target[part] - columns @ solution)**2)))
        return np.array(left)

    def gain(self, other: _Best, one: _Best) -> float:
        """Log-likelihood by which the other one explains y better."""
        # Neighbours of smooth residuals tell little of their own.
        return 0.2 * len(self.rows) * float(np.log(one.squares / max(other.squares, 1e-300)))

    def beats(
        self, other: _Best, one: _Best, noise: float, share: float = EXPLAINED,
    ) -> bool:
        """Whether it explains a share of what one play leaves over."""
        floor = noise**2 * len(self.rows)
        beyond = max(one.squares - floor, 1e-300)
        if self.gain(other, one) < SURE or one.squares - other.squares < share * beyond:
            return False
        # What happens to fit one part of the motion does not fit the other.
        return bool((self.halves(other) < (1.0 - 0.5 * share) * self.halves(one)).all())


def _played(v: Array, gap: float) -> Array:
    """p (N,) of v (N,), from the middle of the gap."""
    return play(v, gap, float(v[0]) + 0.5 * gap)


def _dead_zone(v: Array, centre: float, half: float) -> Array:
    """What is left of v (N,) beyond a zone around a centre."""
    away = v - centre
    return np.asarray(np.sign(away) * np.maximum(np.abs(away) - half, 0.0))


def _stretches(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of each run of true ones."""
    edges = np.diff(np.concatenate([[0], flags.astype(int), [0]]))
    return list(zip(
        np.flatnonzero(edges > 0).tolist(), (np.flatnonzero(edges < 0) - 1).tolist(), strict=True
    ))


def _slope(x: Array, y: Array) -> float:
    known = np.isfinite(y)
    if np.count_nonzero(known) < 3 or np.ptp(x[known]) == 0.0:
        return 0.0
    return float(np.polyfit(x[known] - x[known].mean(), y[known], 1)[0])
