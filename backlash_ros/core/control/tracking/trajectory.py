"""The ideal trajectory: what LQ preview control does with G alone, and where it turns.

    u*(k) = -K x*(k) - K_q q*(k) - sum f_j r(k+j),   x*(k+1) = A x* + B u*,   q*(k+1) = q* + r - y*

It has the references ahead, so it says where u* goes within the next samples, and a turn of u* is
seen before it comes. That decides on which side v is: once per turn, however noisy feedback is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, isnan, nan
from operator import mul

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.tracking.design import TrackingDesign
from backlash_ros.core.control.tracking.reference_window import ReferenceWindow
from backlash_ros.core.plant.backlash import Region

Array = NDArray[np.float64]

# u* has turned where it comes back by more than what the noise of the references does to it, in
# standard deviations: the highest of many samples before a turn is some three above.
TURN_BAND = 6.0
# Nor is it a turn that is so small a share of what u* does within sight, or if it lasted would move
# y by less than that many deviations of its noise: LQ preview rings before a motion.
SMALLEST_TURN, SMALLEST_IN_Y = 0.02, 1.0


@dataclass
class TrajectoryState:
    """Where the trajectory is.

    x: x*, shape (n,). q: q*. side: on which u* moves, GAP until it does. extreme: the furthest u*
    in that direction, nan before there is one. decided: samples for which the side stays.
    """

    x: list[float]
    q: float = 0.0
    side: Region = Region.GAP
    extreme: float = nan
    decided: int = 0


class IdealTrajectory:
    """Follows the references, a sample at a time: `take`, look at it, `advance`.

    noise_std: of y.
    """

    def __init__(self, design: TrackingDesign, noise_std: float) -> None:
        self.noise_std = noise_std
        self.use(design)
        self.state = TrajectoryState([0.0] * design.model.order)
        self.references = ReferenceWindow(
            len(design.gains.preview) - 1, design.model.memory, design.noise_gains
        )
        self.ahead: list[float] = [0.0]  # u* from now on, as far as the references are known
        self.onward = self.state.x  # x* of the next sample
        self.noise_band = 0.0  # how far the noise of the references may turn u*
        self.noise = 0.0  # of u*: what is no turn

    def use(self, design: TrackingDesign) -> None:
        """Be a trajectory of this design from the next sample on; see `replay`."""
        self._design = design
        self._least_per_noise = SMALLEST_IN_Y / design.push_ahead
        self._transition: list[tuple[list[float], float]] = list(
            zip(design.model.a.tolist(), design.model.b.tolist(), strict=True)
        )

    def go_on_from(self, other: IdealTrajectory) -> None:
        """Be where another trajectory of the same model is."""
        self.references, self.state = other.references, replace(other.state)
        self.references.noise_gains = self._design.noise_gains

    def replay(self) -> None:
        """Be where this design would be, had it been in use as long as references are kept."""
        references, state = self.references, self.state
        references.noise_gains = self._design.noise_gains
        if references.empty:
            state.x = [0.0] * self._design.model.order
            return
        state.x, state.q = self._design.replayed(references.all(), references.history)
        self._look_ahead()

    def begin(self, r: float) -> None:
        """Rest at y = r."""
        self.references.fill(r)
        self.state.x = (self._design.model.equilibrium * r).tolist()

    def take(self, y_m: float) -> None:
        """Take in r(k + N), so that u* is known for this sample and those ahead."""
        self.references.append(y_m)
        self.noise_band = TURN_BAND * self.references.u_noise_std
        self._look_ahead()

    @property
    def u(self) -> float:
        """u* of this sample."""
        return self.ahead[0]

    def _look_ahead(self) -> None:
        design, state = self._design, self.state
        plan = design.plan_states @ [*state.x, state.q]
        plan += design.plan_references @ self.references.window
        self.ahead = plan.tolist()
        u = self.ahead[0]
        # Without the call of `dot`: this is made at every sample.
        self.onward = [sum(map(mul, row, state.x)) + b * u for row, b in self._transition]

    def turn(self, band: float, crossing: float) -> Region:
        """Decide on which side v is to be at this sample.

        band: of u*; a turn by less is one only if it lasts for as long as the references are known.
        crossing: samples that v takes across the gap; it leaves for the other side as much before
        the turn as it arrives after it.
        """
        state, ahead = self.state, self.ahead
        if isnan(state.extreme):
            state.extreme = ahead[0]
        taken = ceil(crossing)
        arrival = max(taken - 1, 0)
        least = self._least_per_noise * self.noise_std
        noise = self.noise = max(least, self.noise_band,
                                 SMALLEST_TURN * (max(ahead) - min(ahead)))
        if state.decided > 0:
            state.decided -= 1
        elif state.side is Region.GAP:
            if any(abs(u - state.extreme) > least for u in ahead[:arrival + 1]):
                state.side = _first_move(ahead, state.extreme, noise)
        else:
            peak = _turn(ahead, state.extreme, state.side, noise, band, taken)
            later = ahead[min(arrival, len(ahead) - 1)]
            if peak is not None and peak < taken and (
                (later - state.extreme) * state.side <= 0.0
            ):
                state.side = Region(-state.side)
                state.extreme, state.decided = later, arrival
        if (ahead[0] - state.extreme) * state.side > 0.0 and not state.decided:
            state.extreme = ahead[0]
        return state.side

    @property
    def back(self) -> float:
        """By how much u* has come back without having turned."""
        state = self.state
        return max((state.extreme - self.ahead[0]) * state.side, 0.0)

    @property
    def onward_u(self) -> float:
        """What to go on to: the least that u* is on average from now on, before it turns.

        Noise of the references would push v further and further ahead otherwise.
        """
        side, ahead = self.state.side, self.ahead
        if self.noise > self.noise_band:
            return ahead[0]  # what noise there is does not matter
        least = least_at_peak = peak = ahead[0]
        total = 0.0
        for j, u in enumerate(ahead):
            total += u
            mean = total / (j + 1)
            if (mean - least) * side < 0.0:
                least = mean
            if (u - peak) * side > 0.0:
                peak, least_at_peak = u, least
            elif (u - peak) * side < -self.noise:
                return least_at_peak
        return least

    def bounded(self, u_d: float, beyond: float) -> float:
        """u_d not much further onward than u* soon is: there is no way back but across the gap."""
        if self.state.side is Region.RIGHT:
            return min(u_d, max(self.ahead) + beyond)
        return max(u_d, min(self.ahead) - beyond) if self.state.side is Region.LEFT else u_d

    def advance(self) -> None:
        """Go on to the next sample."""
        state = self.state
        state.q += self.references.window.item(0) - self._design.model.c * state.x[0]
        state.x = self.onward


def _first_move(ahead: list[float], rest: float, band: float) -> Region:
    for u in ahead:
        if abs(u - rest) > band:
            return Region.RIGHT if u > rest else Region.LEFT
    return Region.GAP


def _turn(
    ahead: list[float], extreme: float, side: Region, noise: float, band: float, shortest: int,
) -> int | None:
    """Where u* is furthest before it turns: samples from now on, -1 where that was before.

    It turns where it comes back by more than noise, and by more than the band as well, or for as
    long as references are known; for more than the shortest time. None where it does not.
    """
    peak, furthest_back, turned = -1, 0.0, False
    for j, u in enumerate(ahead):
        beyond = (u - extreme) * side
        if beyond > 0.0:
            if turned and j - peak > shortest and furthest_back < -band:
                return peak
            extreme, peak, furthest_back, turned = u, j, 0.0, False
            continue
        furthest_back = min(furthest_back, beyond)
        turned = turned or beyond < -noise
        if turned and j - peak > shortest and furthest_back < -band:
            return peak
        if turned and beyond > furthest_back + noise and furthest_back >= -band:
            turned = False
    return peak if turned else None
