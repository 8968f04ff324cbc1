"""Where the model of play holds: a gear with more and more inertia, and a slower and slower servo.

    across: J |a| / friction of a sine, from 0.01 to 30
    down: bandwidth of the position loop over the frequency of the sine, from 2 to 100
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import nan

import numpy as np
from reporting import parallel

from backlash_ros.core.estimate import Status
from backlash_ros.core.identification.identification import Options
from gears.gear_runs import close_loop, gear_of, identified, learning

INERTIA, BANDWIDTH = (0.01, 30.0), (2.0, 100.0)
OFF = 0.1  # error of the gap from which on a cell that says *tracking* is wrong
MOSTLY = 0.5  # share of *tracking* from which on a cell is said to track
COASTS = 'the load coasts'  # in what is said


@dataclass(frozen=True)
class Cell:
    """One gear. identified, gap: over the lost motion, by `identify` and at the end of the loop.

    said: by `identify`, empty where it is of use. problem: why there is no loop. tracking_off:
    largest relative error of the gap under *tracking*. states: their shares, by words.
    """

    inertia: float
    bandwidth: float
    said: str
    identified: float
    gap: float
    tracking_off: float
    states: dict[str, float]
    problem: str = ''

    @property
    def identify_says(self) -> str:
        """One of the words of KINDS."""
        if not self.said:
            return 'tracking'
        return 'coasts' if COASTS in self.said else 'other'

    @property
    def loop_says(self) -> str:
        """One of the words of KINDS: a load that coasts is told by `identify` so far."""
        if self.states.get(Status.TRACKING.word, 0.0) >= MOSTLY:
            return 'tracking'
        return 'coasts' if COASTS in self.said else 'other'

    @property
    def wrong(self) -> bool:
        """Whether it said *tracking* while the gap was off."""
        return self.tracking_off > OFF


def cell(job: tuple[float, float]) -> Cell:
    """Identify with the defaults, and close the loop with what was found, of use or not."""
    gear = gear_of(*job)
    source = identified(gear, False, attempts={'': Options()}, slower=())
    lost, found = gear.lost_motion, source.found
    said = '' if found.usable and not source.refused else source.said
    share = found.gap / lost
    if source.parameters is None:
        return Cell(*job, said, share, nan, nan, {}, source.refused)
    try:
        run = close_loop(gear, learning(found, source.parameters), 'sine')
    except (ArithmeticError, ValueError) as error:  # a ParameterError is one
        return Cell(*job, said, share, nan, nan, {}, str(error))
    states = Counter(Status(state).word for state in run.status[run.first:])
    return Cell(
        *job, said, share, float(run.gap[-1]) / lost, run.said_tracking_off_by(lost),
        {word: count / states.total() for word, count in states.most_common()},
    )


def map_cells(side: int, processes: int) -> list[Cell]:
    """All cells, by rows of one bandwidth."""
    jobs = [
        (float(inertia), float(bandwidth))
        for bandwidth in np.geomspace(*BANDWIDTH, side) for inertia in np.geomspace(*INERTIA, side)
    ]
    return parallel(cell, jobs, 'map', processes)


def summary(cells: list[Cell]) -> str:
    """How many cells say what."""
    says = Counter(one.loop_says for one in cells)
    wrong = sum(one.wrong for one in cells)
    return (
        f'{len(cells)} cells: in {says["tracking"]} the loop says *tracking*, in {says["coasts"]} '
        f'that the load coasts, in {says["other"]} neither; {wrong} said *tracking* with the gap '
        f'off by more than {OFF:.0%}.'
    )


HEADER = ('J\\|a\\|/τ_c', 'bandwidth', 'gap identified', 'gap in the loop', 'off while tracking',
          'states', 'identify says')


def wrong_rows(cells: list[Cell]) -> list[list[str]]:
    """The cells that said *tracking* while the gap was off, and those without a loop."""
    return [
        [f'{one.inertia:.2g}', f'{one.bandwidth:.3g}', f'{one.identified:.3f}', f'{one.gap:.3f}',
         f'{one.tracking_off:.0%}',
         one.problem or ', '.join(f'{word} {share:.0%}' for word, share in one.states.items()),
         one.said or 'of use']
        for one in cells if one.wrong or one.problem
    ]
