"""The ideal trajectory: what LQ preview control does with G alone, and where it turns.

    u*(k) = -K x*(k) - K_q q*(k) - sum f_j r(k+j),   x*(k+1) = A x* + B u*,   q*(k+1) = q* + r - y*

A turn of u* is foreseen, and decides when v changes sides: once per turn, however noisy feedback
is.
"""

from dataclasses import dataclass
from math import ceil, dist, inf, isnan, nan

import numpy as np

from backlash_ros.core.control.tracking.design import TrackingDesign, parabolas
from backlash_ros.core.plant.backlash import GAP, RIGHT, Region
from backlash_ros.core.plant.numerics import NoiseLevel, dot
from backlash_ros.core.plant.transfer_function import Array, powers

# Fraction of m (c_r - c_l) by which u has to be off at the end of a move to be worth a crossing: a
# load that v meets at full speed may be thrown as far.
WORTH_CROSSING = 0.1
QUIET = 0.02  # fraction of m (c_r - c_l) by which noise of the references may move u*


class ReferenceWindow:
    """r(k) .. r(k + N), smoothed against noise of y_m, and `history` older ones; preview: N.

    Each is replaced by the middle of a parabola through as many neighbours as fit one within their
    noise; the newest, up to N / 3, stay. noise_gains: std of u* for unit noise, unsmoothed and for
    each width, shape (widths + 1,). u_noise_std: largest std of u* by the noise that is left.
    """

    def __init__(self, preview: int, history: int, noise_gains: Array) -> None:
        self.noise_gains = noise_gains
        self._preview, self._kept = preview, history + preview + 1
        # References as they came, as they are used, and std of u* for unit noise in them. Filled
        # from left to right; once the rows are full, the newest columns move to the front.
        self._rows: Array = np.zeros((3, 2 * self._kept))
        self._end = 0
        self.noise = NoiseLevel()  # of the references as they came
        self.u_noise_gain = float(noise_gains[0])
        self.u_noise_std = self.noise_spread = self.low = self.high = 0.0

    @property
    def empty(self) -> bool:
        return self._end == 0

    @property
    def window(self) -> Array:
        """r(k) .. r(k + N), shape (N + 1,)."""
        return self._rows[1, self._end - self._preview - 1:self._end]

    def all(self) -> Array:
        """All references that are kept, the newest last, shape (up to history + N + 1,)."""
        return self._rows[1, max(0, self._end - self._kept):self._end]

    def fill(self, value: float) -> None:
        """Fill the window with this value."""
        self._end = self._preview + 1
        self._rows[:2, :self._end] = value
        self._rows[2, :self._end] = 0.0

    def lead_to(self, value: float) -> None:
        """Bend the window so that it ends at this value, if that would be a jump from its end."""
        window = self.window
        jump = value - float(window[-1])
        # How the reference got there is not known; an unbent window would show a jump.
        if self._preview and abs(jump) > float(np.abs(np.diff(window)).max()):
            self._rows[:2, self._end - len(window):self._end] += np.linspace(0.0, jump, len(window))

    def append(self, value: float) -> None:
        """Take in r(k + N)."""
        self._rows[1, self._end] = value
        self._end += 1

    def settle(self) -> None:
        """Smooth the references and measure their noise, for the next sample."""
        newest, half = self._end - 1, max(parabolas(self._preview)[2], default=0)
        self._rows[0, newest] = self._rows[1, newest]
        self._rows[2, newest] = self.noise_gains[0]
        self.noise.take(self._rows.item(0, newest))
        std = self.noise.std
        if half and std > 0.0:
            self._average(newest - half)
        window = self.window
        self.low, self.high = float(window.min()), float(window.max())
        if std > 0.0:
            self.noise_spread = 8.0 * std  # the most that it adds to high - low
            first = self._end - self._preview - 1
            self.u_noise_gain = float(self._rows[2, first:max(self._end - half, first + 1)].max())
            self.u_noise_std = std * self.u_noise_gain
        if self._end == self._rows.shape[1]:
            self._rows[:, :self._kept] = self._rows[:, -self._kept:]
            self._end = self._kept

    def _average(self, at: int) -> None:
        # Mean square residual of a parabola, in variances of the noise, up to which it is used in
        # full, and from which on it is not used: there is a step, or a sharp turn.
        full, none = 1.8, 3.0
        fits, first, widths = parabolas(self._preview)
        residuals = fits @ self._rows[0, at - widths[-1]:at + widths[-1] + 1]
        in_stds = residuals / self.noise.std  # squares of the residuals themselves might underflow
        squares = np.add.reduceat(in_stds * in_stds, first).tolist()
        reference = value = self._rows.item(0, at)
        gain = float(self.noise_gains[0])
        for i, (w, row, square) in enumerate(zip(widths, first, squares, strict=True)):
            weight = min((none - square / (2 * w - 2)) / (none - full), 1.0)
            if weight > 0.0:
                value += weight * (reference - residuals.item(row + w) - value)
                gain += weight * (self.noise_gains.item(i + 1) - gain)
        self._rows[1, at], self._rows[2, at] = value, gain


@dataclass
class Turning:
    """On which side u* moves, and where it turns."""

    side: Region = GAP  # on which u* moves
    decided: int = 0  # coming samples in which the side cannot change
    extreme: float = nan  # furthest u* on that side so far
    furthest: float = nan  # u* to which u goes without turning
    turns_in: int = 0  # samples until u* turns; len(ahead) if it does not turn within these
    since: int = 0  # samples since it last turned
    stays: bool = False  # whether v stays on this side, as u* comes to rest close to it


class IdealTrajectory:
    """Trajectory of G for the references; at each sample call `take`, `turn`, then `prepare`.

    x, q: x* (n,) and q*. ahead: u* from this sample on, shape (L,). moved: distance from the x* of
    the sample before. spread: range of the references in the window, beyond their noise.
    """

    def __init__(self, design: TrackingDesign) -> None:
        self.x, self.q, self.ahead = [0.0] * design.model.order, 0.0, [0.0]
        self.moved = self.spread = 0.0
        self.turning, plan = Turning(), design.plans[0]
        self.references = ReferenceWindow(
            len(plan.references[0]) - 1, design.model.memory, plan.noise_gains)
        self.use(design)

    @property
    def u(self) -> float:
        return self.ahead[0]

    @property
    def aim(self) -> float:
        """u* of this sample, or Turning.furthest if u* goes beyond that without a turn to come.

        While v stays on its side, what u* comes back is not followed.
        """
        side, furthest = self.turning.side, self.turning.furthest
        if self.turning.stays:
            return min(max(self.u * side, self.turning.extreme * side), furthest * side) * side
        return furthest if side is not GAP and (self.u - furthest) * side > 0.0 else self.u

    @property
    def back(self) -> float:
        """By how much u* has come back from its extreme without having turned."""
        return max((self.turning.extreme - self.u) * self.turning.side, 0.0)

    @property
    def noise_band(self) -> float:
        """How far u* may come back by noise of the references alone."""
        # The extreme of many samples before a turn is some three standard deviations too far out.
        return 6.0 * self.references.u_noise_std

    def use(self, design: TrackingDesign, softness: int = 0) -> None:
        """Use this plan of a design from the next sample on; softness: its index."""
        self.design, self.softness, self._plan = design, softness, design.plans[softness]
        self.references.noise_gains = self._plan.noise_gains
        self._due: list[float] | None = None  # u* ahead at the next sample, without its reference
        self._of_newest: list[float] = self._plan.references[:, -1].tolist()
        self._transition: list[tuple[list[float], float]] = list(
            zip(design.model.a.tolist(), design.model.b.tolist(), strict=True))

    def soften(self, gap_u: float) -> bool:
        """Choose the plan for the noise of the references and the gap; return if it changed."""
        # Std of u* by each plan for unit noise that is smoothed by the widest parabola.
        of_noise = [plan.noise_gains.item(-1) for plan in self.design.plans]
        now, noise_std = self.softness, self.references.noise.std
        most = QUIET * gap_u / noise_std if noise_std > 0.0 else inf
        if gap_u == 0.0:
            return False
        # A change has to gain a factor of two, as the noise is known no better, and softer plans
        # follow the reference less closely.
        if of_noise[now] > most:
            other = next((i for i, gain in enumerate(of_noise) if gain <= most),
                         of_noise.index(min(of_noise)))
            other = other if 2.0 * of_noise[other] <= of_noise[now] else now
        else:
            other = next((i for i, gain in enumerate(of_noise[:now]) if 2.0 * gain <= most), now)
        if other == now:
            return False
        self.use(self.design, other)
        return True

    def replay(self) -> None:
        """Set x*, q* and u* as if this design had been in use since the oldest reference kept."""
        plan, model = self._plan, self.design.model
        # z(k+1) = F z(k) + [B; 0] u_p + [0; 1] r with u_p = -sum f_j r(k+j).
        n, references = model.order, self.references.all()
        inputs = np.zeros((n + 1, 2))
        inputs[:n, 0], inputs[n, 1] = model.b, 1.0
        by_preview = -np.convolve(references, plan.gains.preview[::-1], 'valid')
        steps = len(by_preview) - 1  # the newest one makes the next state
        start = np.append(model.equilibrium * references[0], 0.0)
        pairs = np.column_stack([by_preview[:steps], references[:steps]])[::-1]
        z = np.linalg.matrix_power(plan.closed, steps) @ start + np.einsum(
            'kij,kj->i', powers(plan.closed, inputs, steps), pairs)
        self.x, self.q = z[:n].tolist(), float(z[n])
        self.ahead = self._ahead(self.references.window)

    def begin(self, r: float) -> None:
        """Begin at rest with y = r."""
        self.references.fill(r)
        self._due = None
        self.x = (self.design.model.equilibrium * r).tolist()

    def lead_to(self, y_m: float) -> None:
        """Bend the references so that they lead to y_m without a jump."""
        self.references.lead_to(y_m)
        self._due = None

    def take(self, y_m: float) -> None:
        """Take in y_m as r(k + N), and compute u* for this sample and those ahead."""
        references, r = self.references, float(y_m)
        due = self._ahead(references.window[1:]) if self._due is None else self._due
        references.append(r)
        self.spread = max(references.high, r) - min(references.low, r) - references.noise_spread
        # Without NumPy, whose first calls after a pause cost the command several microseconds.
        self.ahead = [u + gain * r for u, gain in zip(due, self._of_newest, strict=True)]

    def turn(self, noise_std: float, gap_u: float, band: float, crossing: float) -> bool:
        """Decide on which side v is to be at this sample; return whether the side has changed.

        noise_std: of y. gap_u: m (c_r - c_l). band: of u*, see `_turn`. crossing: samples that v
        takes to cross the gap; it leaves as long before the turn as it arrives after it.
        """
        ahead, turning, before = self.ahead, self.turning, self.turning.side
        taken, turns_in, stays = ceil(crossing), 0, False
        if isnan(turning.extreme):
            turning.extreme = ahead[0]
        arrival = max(taken - 1, 0)
        # What moves y by less than its noise is no turn, unless it is a hundredth of the gap.
        least = min(noise_std / self.design.push_ahead, 0.01 * gap_u)
        noise = max(least, self.noise_band)
        if turning.decided > 0:
            turning.decided -= 1
        elif before is GAP:
            moves = [u - turning.extreme for u in ahead]
            if max(map(abs, moves[:arrival + 1])) > least:
                first = next((move for move in moves if abs(move) > noise), 0.0)
                turning.side = Region((first > 0.0) - (first < 0.0))
        else:
            peak = _turn(ahead, turning.extreme, before, noise, band, taken)
            # A swing that v has begun to follow is followed to its end.
            if (peak is not None or turning.stays) and turning.since > len(ahead):
                stays = self._stays(gap_u, taken)
            peak = None if stays else peak
            turns_in = len(ahead) if peak is None else max(peak, 0)
            later = ahead[min(arrival, len(ahead) - 1)]
            if peak is not None and peak < taken and (later - turning.extreme) * before <= 0.0:
                turning.side = Region(-before)
                turning.extreme, turning.decided = later, arrival
        turning.stays, turning.turns_in = stays, turns_in if turning.side is before else 0
        most, least_of = (max, min) if turning.side is RIGHT else (min, max)
        turning.furthest = most(ahead)
        if turning.turns_in == len(ahead) and (
                stays or least_of(ahead[ahead.index(turning.furthest):]) != ahead[-1]):
            # A swing that is no turn and is over within `ahead` is not followed there and back.
            turning.furthest = ahead[-1]
        newest = self.aim if stays else ahead[0]
        onward = (newest - turning.extreme) * turning.side > 0.0 and not turning.decided
        # At rest, what is left of the swing is no reason to turn early for the next move.
        if onward or (stays and max(ahead) - min(ahead) <= least):
            turning.extreme = newest
        turning.since = turning.since + 1 if turning.side is before else 0
        return turning.side is not before

    def _stays(self, gap_u: float, taken: int) -> bool:
        """Whether u* comes to rest on its side, and nothing before that is worth crossing the gap.

        Nothing is if u, held where u* comes to rest, differs from u* by little, or by more for less
        time than v takes there and back.
        """
        ahead, side, little = self.ahead, self.turning.side, WORTH_CROSSING * gap_u
        later = self.references.window[len(ahead) - 1:]
        rest, furthest, off = ahead[-1] * side, self.turning.extreme * side, list[int]()
        if furthest - rest > little or float(np.ptp(later)) > self.references.noise_spread:
            return False
        for j, u in enumerate(ahead):
            furthest = max(furthest, u * side)
            if abs(u * side - min(furthest, rest)) > little:
                off.append(j)
        return not off or off[-1] - off[0] < 2 * taken

    @property
    def noise(self) -> tuple[Array, float]:
        """Plan.x_noise for references smoothed like these, and the std of their noise."""
        by_width = np.abs(self._plan.noise_gains - self.references.u_noise_gain)
        return self._plan.x_noise[int(by_width.argmin())], self.references.noise.std

    def advance(self) -> None:
        """Advance x* and q* to the next sample."""
        before = self.x
        self.q += self.references.window.item(0) - self.design.model.c * before[0]
        self.x = [dot(row, before) + b * self.u for row, b in self._transition]
        self.moved = dist(self.x, before)

    def prepare(self) -> None:
        """Advance to the next sample, and compute all that does not depend on its reference."""
        self.advance()
        self.references.settle()
        self._due = self._ahead(self.references.window[1:])

    def _ahead(self, references: Array) -> list[float]:
        """Return u* for this sample and those ahead, by [x*; q*] and these references."""
        gains = self._plan.references[:, :len(references)]
        ahead: list[float] = (self._plan.states @ [*self.x, self.q] + gains @ references).tolist()
        return ahead


def _turn(
    ahead: list[float], extreme: float, side: Region, noise: float, band: float, shortest: int,
) -> int | None:
    """Return in how many samples u* is furthest before it turns (-1: it was already), or None.

    It turns if it comes back by more than noise, and then either by more than the band, later than
    `shortest` samples after its extreme, or until the end of `ahead`.
    """
    peak, furthest_back, turned = -1, 0.0, False
    for j, u in enumerate(ahead):
        beyond = (u - extreme) * side
        if beyond <= 0.0:
            furthest_back = min(furthest_back, beyond)
            turned = turned or beyond < -noise
        if turned and j - peak > shortest and furthest_back < -band:
            return peak
        if beyond > 0.0:
            extreme, peak, furthest_back, turned = u, j, 0.0, False
        elif turned and beyond > furthest_back + noise and furthest_back >= -band:
            turned = False
    return peak if turned else None
