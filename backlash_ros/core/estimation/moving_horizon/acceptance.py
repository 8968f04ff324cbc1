"""Which fits are precise enough to be published, or to take the place of what held."""

from __future__ import annotations

from collections.abc import Sequence

from backlash_ros.core.estimate import Bounds
from backlash_ros.core.estimation.constants import BY_CHANCE, NO_GAP, PRECISE_GAP, PRECISE_SLOPE
from backlash_ros.core.estimation.fit.crossings import Crossings
from backlash_ros.core.estimation.fit.prior import Prior
from backlash_ros.core.estimation.fit.relabelling import Fitted

# --- guards
BOUND_ROUNDING = 1e-9  # relative distance from a bound that is none


def usable(result: Fitted, bounds: Bounds, share: float = 1.0) -> Crossings | None:
    """The crossings of a fit if they are precise and within the bounds by their deviations.

    share: of the usual deviations that is allowed.
    """
    found = result.solution.crossings
    if found is None or not is_precise(found, result.fit.swing, share):
        return None
    values = (found.m, found.c_r, found.c_l)
    outside = outside_bounds(values, (found.std_m, found.std_c_r, found.std_c_l), bounds)
    return None if any(outside) else found


def is_precise(found: Crossings, swing: float, share: float = 1.0) -> bool:
    """Whether slope and crossings are known well enough where v swings by so much; share: above."""
    return (
        found.std_m <= share * PRECISE_SLOPE * found.m
        and max(found.std_gap, found.std_c_r, found.std_c_l)
        <= share * largest_gap_std(found.gap, swing)
    )


def differs(found: Crossings, prior: Prior) -> bool:
    """Whether slope or crossings are further from a prior than an estimate may be uncertain."""
    m, product_r, product_l = map(float, prior.theta)
    c_r, c_l = product_r / m, product_l / m
    furthest = max(abs(found.c_r - c_r), abs(found.c_l - c_l))
    return abs(found.m - m) > PRECISE_SLOPE * m or furthest > PRECISE_GAP * (c_r - c_l)


def largest_gap_std(gap: float, swing: float) -> float:
    """Deviation up to which a gap counts as known, where v swings by so much."""
    return max(PRECISE_GAP * gap, NO_GAP * swing)


def outside_bounds(
    values: tuple[float, float, float], stds: Sequence[float], bounds: Bounds,
) -> list[bool]:
    """Whether m, c_r, c_l lie outside of their bounds by more than their deviations explain."""
    return [
        abs(value - near) > BY_CHANCE * std + BOUND_ROUNDING * abs(near)
        for value, std, near in zip(values, stds, bounds.project(*values), strict=True)
    ]
