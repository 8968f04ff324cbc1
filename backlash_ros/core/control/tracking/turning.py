"""On which side of the gap v is: one crossing per turn of the ideal trajectory.

A crossing costs wear and noise. The trajectory has no noise and is known ahead, so it decides.
Feedback may ask for the other side as well, where y is pushed; but it carries the noise of y, and
only what is larger than that is worth a crossing.
"""

from __future__ import annotations

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.plant.backlash import Region

NOISE_BAND = 4.0  # standard deviations of what feedback makes of noise


def side_for(
    u_d: float, asked: Region, turned: bool, noise: float, come_back: float,
    inverse: BacklashInverse,
) -> Region:
    """Return the side for u_d.

    asked: by the trajectory. turned: whether it asks so since this sample. noise: what of u_d
    may be noise. come_back: by how much u* has without having turned: where feedback has turned
    before the trajectory does, that is no reason to turn again.
    """
    side = inverse.side
    if asked is Region.GAP or side is Region.GAP:
        return asked
    back = (inverse.held_u - u_d) * side
    if turned:
        # Limits may have kept v so far behind that u still has to go on.
        return asked if side is asked or back > -(noise + come_back) else side
    band = come_back + (noise if side is asked else 0.0)
    turns = back > max(band, inverse.direction_band)
    return Region(-side) if turns else side
