"""Where the model of play holds: a gear with more and more inertia, and a slower and slower servo.

    across: J |a| / friction of a sine, from 0.01 to 30
    down: bandwidth of the position loop over the frequency of the sine, from 2 to 100
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan, pi

import numpy as np
from gear_runs import PRESETS, close_loop, identified, learning
from reporting import parallel, processors

from backlash_ros.core.estimation.protocol import Status

INERTIA, BANDWIDTH = (0.01, 30.0), (2.0, 100.0)
HEAVY_MOTOR, DAMPED = 1000.0, 0.8  # times the load, so that friction hardly turns it back; ratio
HEADROOM = 1.5  # of the limits over what the sine needs
RESOLUTION = 2.0 * pi / 2**16


@dataclass(frozen=True)
class Cell:
    """gap: found over lost motion, by identification and at the end of the loop."""

    inertia: float
    bandwidth: float
    usable: bool
    identified: float
    gap: float
    tracking_off: float
    tracking: float

    @property
    def text(self) -> str:
        """Errors of the gap in %, by identification and by the loop; t: share of tracking.

        x: identification says that it is not of use. !: wrong by more than 10 % under tracking.
        """
        said = '' if self.usable else 'x '
        if np.isnan(self.gap):
            return f'{said}{100.0 * (self.identified - 1.0):+.0f} refused'
        return f'{said}{100.0 * (self.identified - 1.0):+.0f} {100.0 * (self.gap - 1.0):+.0f} ' \
               f't{self.tracking:.0%}' + ('!' if self.tracking_off > 0.1 else '')


def cell(job: tuple[float, float]) -> Cell:
    """Identify and close the loop with one gear."""
    inertia, bandwidth = job
    base = PRESETS['servo']
    w = 2.0 * pi * base.frequency
    acceleration, motor = base.swing * w**2, HEAVY_MOTOR * base.load_inertia
    servo = bandwidth * w
    gear = replace(
        base, friction=base.load_inertia * acceleration / inertia, viscous=0.0,
        motor_inertia=motor, stiffness=motor * servo**2, damping=2.0 * DAMPED * motor * servo,
        torque_limit=1e6, motor_resolution=RESOLUTION, load_resolution=RESOLUTION,
        reach=HEADROOM * base.swing, rate=HEADROOM * base.swing * w,
    )
    source = identified(gear, False)
    found, lost = source.found, gear.lost_motion
    usable = found.usable and not source.refused
    if source.parameters is None:
        return Cell(inertia, bandwidth, False, found.gap / lost, nan, nan, nan)
    try:
        run = close_loop(gear, learning(found, source.parameters), 'sine')
    except (ArithmeticError, ValueError):  # a ParameterError is one
        return Cell(inertia, bandwidth, False, found.gap / lost, nan, nan, nan)
    tracking = float(np.mean(run.status[run.first:] == Status.TRACKING))
    return Cell(
        inertia, bandwidth, usable, found.gap / lost, float(run.gap[-1]) / lost,
        run.said_tracking_off_by(lost), tracking,
    )


def map_table(side: int) -> tuple[list[str], list[list[str]]]:
    """The map as header and rows."""
    across, down = np.geomspace(*INERTIA, side), np.geomspace(*BANDWIDTH, side)
    cells = parallel(
        cell, [(float(i), float(b)) for b in down for i in across], 'map', processors()
    )
    header = ['bandwidth', *(f'{i:.2g}' for i in across)]
    return header, [
        [f'{b:.3g}', *(one.text for one in cells[side * k:side * (k + 1)])]
        for k, b in enumerate(down)
    ]
