"""How far an estimate of the backlash is relied on: what is inverted, and how hard feedback is.

The first estimate may be confidently wrong, which the samples after it contradict. So feedback
hardens step by step as it holds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isnan, nan

from backlash_ros.core.estimate import Estimate, Status

# Samples for which an estimate has to hold before it gets full feedback.
TRUSTED_AFTER = 40
# An estimate this sharp, in relative deviations of slope and gap, counts so many times per sample.
SHARP, SHARP_COUNTS = 0.01, 17


@dataclass
class TrustState:
    """What was made of the estimates so far.

    known: whether the newest comes from data of this loop. slope: that is inverted. crossings: that
    are inverted, shrunk by their uncertainty. held_for: samples for which estimates have held,
    sharp ones counted more. in_use_for: samples since there is one. sharp_counts: see SHARP.
    """

    known: bool = False
    slope: float = nan
    crossings: tuple[float, float] = (0.0, 0.0)
    held_for: int = 0
    in_use_for: int = 0
    sharp_counts: int = SHARP_COUNTS


class Trust:
    """Judges each estimate. shrinkage: standard deviations by which crossings are shrunk."""

    def __init__(self, shrinkage: float) -> None:
        self.state = TrustState()
        self._shrinkage = shrinkage
        self._newest: Estimate | None = None

    def go_on_from(self, other: Trust, state_known: bool) -> None:
        """Rely on what another loop did; anew, more slowly, where x_hat begins anew."""
        self.state = replace(other.state)
        if not state_known:
            # However well the backlash is known, the first x_hat are full of noise.
            self.state = TrustState(sharp_counts=1)

    def take(self, estimate: Estimate) -> bool:
        """Take in the estimate of this sample; returns whether it is another one."""
        if estimate is self._newest:
            return False
        self._newest, state = estimate, self.state
        state.known = _is_known(estimate, state.known)
        state.crossings = shrunk_crossings(estimate, self._shrinkage, state.known)
        # On the way to its first agreement with the data the m of a law without deviations may be
        # anywhere within its bounds.
        if isnan(state.slope) or estimate.learned or estimate.status is Status.TRACKING:
            state.slope = estimate.m
        return True

    def count(self, estimate: Estimate, first: bool, u_scale: float) -> None:
        """Count this sample for the estimate.

        first: of this loop, where an estimate was known before. u_scale: size of u.
        """
        state = self.state
        if not (state.known and estimate.learned):
            # Without deviations nobody knows how far it may be relied on.
            state.held_for = state.in_use_for = 0
            return
        state.in_use_for += 1
        if first:
            state.held_for = TRUSTED_AFTER
        elif state.held_for < TRUSTED_AFTER:
            state.held_for += state.sharp_counts if _is_sharp(estimate, u_scale) else 1

    @property
    def begun(self) -> bool:
        """Whether an estimate is relied on at all."""
        return self.state.held_for > 0

    @property
    def full(self) -> bool:
        """Whether it has held for long enough."""
        return self.state.held_for >= TRUSTED_AFTER

    def share(self, levels: int) -> int:
        """How many of so many levels it has reached."""
        return self.state.held_for * levels // TRUSTED_AFTER


def _is_known(estimate: Estimate, before: bool) -> bool:
    """Whether an estimate comes from data of this loop; before: whether the one before it did."""
    status = estimate.status
    if status in (Status.ACQUIRING, Status.INCONSISTENT):
        # What was learned before a restart says nothing yet about the state of G.
        return False
    # A law without deviations says by its status alone that it has learned, and holds that later.
    return before or estimate.learned or status is Status.TRACKING


def _is_sharp(estimate: Estimate, u_scale: float) -> bool:
    # Beside far larger u even a gap that is hardly known makes little difference.
    large = max(estimate.c_r - estimate.c_l, u_scale / estimate.m)
    std_gap = estimate.std_c_r + estimate.std_c_l
    return estimate.std_m < SHARP * estimate.m and std_gap < SHARP * large


def shrunk_crossings(
    estimate: Estimate, deviations: float, known: bool,
) -> tuple[float, float]:
    """Crossings shrunk towards each other by their uncertainty; both 0 while nothing is known.

    Over-compensation drives past the gap and starts a limit cycle, under-compensation only
    leaves a rest of the backlash: in a loop around y the smaller gap is the safe one. Where a law
    knows no uncertainty there is nothing to shrink by once the crossings are known.
    """
    if deviations == 0.0:
        return estimate.c_r, estimate.c_l
    if isnan(estimate.std_c_r):
        return (estimate.c_r, estimate.c_l) if known else (0.0, 0.0)
    middle = 0.5 * (estimate.c_r + estimate.c_l)
    return (
        max(estimate.c_r - deviations * estimate.std_c_r, middle),
        min(estimate.c_l + deviations * estimate.std_c_l, middle),
    )
