"""The ideal trajectory: what LQ preview control does with G alone, and where it turns.

    u*(k) = -K x*(k) - K_q q*(k) - sum f_j r(k+j),   x*(k+1) = A x* + B u*,   q*(k+1) = q* + r - y*

A turn of u* is seen before it comes. That decides on which side v is: once per turn, however noisy
feedback is.
"""

from dataclasses import dataclass, field
from math import ceil, dist, isnan, nan

import numpy as np

from backlash_ros.core.control.tracking.design import TrackingDesign, dot
from backlash_ros.core.control.tracking.preview import ReferenceWindow
from backlash_ros.core.plant.backlash import Region
from backlash_ros.core.plant.transfer_function import Array, powers

QUIET = 0.02  # share of the u that the gap takes, by which noise of the references may move u*


@dataclass
class TrajectoryState:
    """Where the trajectory is, and where it goes."""

    x: list[float]  # x*, shape (n,)
    q: float = 0.0  # q*
    side: Region = Region.GAP  # on which u* moves
    extreme: float = nan  # furthest u* on it
    decided: int = 0  # samples for which it stays
    turns_in: int = 0  # samples until u* turns, or all that are known ahead
    furthest: float = nan  # u* to which u goes without turning
    ahead: list[float] = field(default_factory=lambda: [0.0])  # u* from this sample on
    moved: float = 0.0  # by how much x* did
    noise_band: float = 0.0  # how far noise of the references may turn u*

    @property
    def u(self) -> float:
        return self.ahead[0]

    @property
    def aim(self) -> float:
        """u* of this sample, or what it comes back to without having turned."""
        passes = self.side is not Region.GAP and (self.u - self.furthest) * self.side > 0.0
        return self.furthest if passes else self.u

    @property
    def back(self) -> float:
        """By how much u* has come back without having turned."""
        return max((self.extreme - self.u) * self.side, 0.0)


class IdealTrajectory:
    """Follows the references, a sample at a time: `take`, `turn`, `prepare` for the next one."""

    def __init__(self, design: TrackingDesign) -> None:
        self.state, plan = TrajectoryState([0.0] * design.model.order), design.plans[0]
        self.references = ReferenceWindow(
            len(plan.references[0]) - 1, design.model.memory, plan.noise_gains)
        self.use(design)

    def use(self, design: TrackingDesign, softness: int = 0) -> None:
        """Be this one of the trajectories of a design from the next sample on."""
        self._design, self.softness, self._plan = design, softness, design.plans[softness]
        self.references.noise_gains = self._plan.noise_gains
        self._newest_gains: list[float] = self._plan.references[:, -1].tolist()
        self._due: list[float] | None = None  # u* ahead at the next sample, but for its reference
        self._transition: list[tuple[list[float], float]] = list(
            zip(design.model.a.tolist(), design.model.b.tolist(), strict=True))

    def soften(self, gap_u: float) -> bool:
        """Ask for less where noise of references makes u* cross a gap of this u; say if so."""
        # What each plan makes of noise that is averaged over the widest parabola.
        of_noise = [plan.noise_gains.item(-1) for plan in self._design.plans]
        now, noise_std = of_noise[self.softness], self.references.noise.std
        if gap_u == 0.0 or noise_std * now <= QUIET * gap_u:
            return False
        softer = next((i for i, gain in enumerate(of_noise) if noise_std * gain <= QUIET * gap_u),
                      of_noise.index(min(of_noise)))
        if of_noise[softer] > 0.5 * now:
            return False  # nothing is won: what moves u* is the reference itself
        self.use(self._design, softer)
        return True

    def replay(self) -> None:
        """Be where this design would be, from rest at the oldest reference that is kept on."""
        state, plan, model = self.state, self._plan, self._design.model
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
        state.x, state.q = z[:n].tolist(), float(z[n])
        state.ahead = self._ahead(self.references.window)

    def begin(self, r: float) -> None:
        """Rest at y = r."""
        self.references.fill(r)
        self._due = None
        self.state.x = (self._design.model.equilibrium * r).tolist()

    def lead_to(self, y_m: float) -> None:
        """Let the references lead to one that is not what would have come next."""
        self.references.lead_to(y_m)
        self._due = None

    def take(self, y_m: float) -> TrajectoryState:
        """Take in r(k + N), so that u* is known for this sample and those ahead."""
        due, r = self._due or self._ahead(self.references.window[1:]), float(y_m)
        self.references.append(r)
        self.state.ahead = [u + gain * r for u, gain in zip(due, self._newest_gains, strict=True)]
        return self.state

    def turn(self, noise_std: float, gap_u: float, band: float, crossing: float) -> bool:
        """Decide on which side v is to be at this sample; returns whether it is another one.

        noise_std: of y. gap_u: u that the gap takes. band: of u*, see `_turn`. crossing: samples
        that v takes across the gap; it leaves as much before the turn as it arrives after it.
        """
        state, ahead = self.state, self.state.ahead
        if isnan(state.extreme):
            state.extreme = ahead[0]
        before, taken, turns_in = state.side, ceil(crossing), 0
        arrival = max(taken - 1, 0)
        # What moves y by less than its noise is no turn, unless it is a hundredth of the gap.
        least = min(noise_std / self._design.push_ahead, 0.01 * gap_u)
        noise = max(least, state.noise_band)
        if state.decided > 0:
            state.decided -= 1
        elif before is Region.GAP:
            moves = [u - state.extreme for u in ahead]
            if max(map(abs, moves[:arrival + 1])) > least:
                first = next((move for move in moves if abs(move) > noise), 0.0)
                state.side = Region((first > 0.0) - (first < 0.0))
        else:
            peak = _turn(ahead, state.extreme, before, noise, band, taken)
            turns_in = len(ahead) if peak is None else max(peak, 0)
            later = ahead[min(arrival, len(ahead) - 1)]
            if peak is not None and peak < taken and (later - state.extreme) * before <= 0.0:
                state.side = Region(-before)
                state.extreme, state.decided = later, arrival
        if (ahead[0] - state.extreme) * state.side > 0.0 and not state.decided:
            state.extreme = ahead[0]
        state.turns_in = turns_in if state.side is before else 0
        most, least_of = (max, min) if state.side is Region.RIGHT else (min, max)
        state.furthest = most(ahead)
        if state.turns_in == len(ahead) \
                and least_of(ahead[ahead.index(state.furthest):]) != ahead[-1]:
            # A swing that is no turn, and over: it is not followed there and back.
            state.furthest = ahead[-1]
        return state.side is not before

    @property
    def noise(self) -> tuple[Array, float]:
        """Covariance of x* for noise of 1 in references averaged as these are, and their noise."""
        by_width = np.abs(self._plan.noise_gains - self.references.u_noise_gain)
        return self._plan.x_noise[int(by_width.argmin())], self.references.noise.std

    def advance(self) -> None:
        """Go on to the next sample."""
        state, before = self.state, self.state.x
        state.q += self.references.window.item(0) - self._design.model.c * before[0]
        state.x = [dot(row, before) + b * state.u for row, b in self._transition]
        state.moved = dist(state.x, before)

    def prepare(self) -> None:
        """Do what the next sample needs, and its reference does not change."""
        self.advance()
        self.references.settle()
        # The highest of many samples before a turn is some three deviations above.
        self.state.noise_band = 6.0 * self.references.u_noise_std
        self._due = self._ahead(self.references.window[1:])

    def _ahead(self, references: Array) -> list[float]:
        """u* from [x*; q*] and these references on, as many as there are."""
        gains = self._plan.references[:, :len(references)]
        ahead = self._plan.states @ [*self.state.x, self.state.q] + gains @ references
        return [float(u) for u in ahead]


def _turn(
    ahead: list[float], extreme: float, side: Region, noise: float, band: float, shortest: int,
) -> int | None:
    """Where u* is furthest before it turns: samples from now on, -1 where that was before; or None.

    It turns where it comes back by more than noise, and by more than the band as well, or for as
    long as references are known; for more than the shortest time.
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
