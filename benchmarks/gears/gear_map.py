"""Where the model of play holds: a gear with more and more inertia, and a slower and slower servo.

    across: J |a| / friction of a sine, from 0.01 to 30
    down: bandwidth of the position loop over the frequency of the sine, from 2 to 100
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from math import nan, pi
from multiprocessing import Pool
from pathlib import Path

import numpy as np
from reporting import ROOT
from tqdm import tqdm

from backlash_ros.core.estimate import Status
from backlash_ros.core.identification.identification import Options
from gears.gear_runs import PRESETS, Gear, close_loop, identified, learning

INERTIA, BANDWIDTH = (0.01, 30.0), (2.0, 100.0)
HEAVY_MOTOR, DAMPED = 1000.0, 0.8  # times the load, so that friction hardly turns it back; ratio
HEADROOM = 1.5  # of the limits over what the sine needs
RESOLUTION = 2.0 * pi / 2**16
OFF = 0.1  # error of the gap from which on a cell that says *tracking* is wrong
MOSTLY = 0.5  # share of *tracking* from which on a cell is said to track
COASTS = 'the load coasts'  # in what is said
FILE = ROOT / 'results' / 'physics_map.jsonl'
# A result is taken from the file only where all that it depends on is as it was.
SOURCES = ('backlash_ros/core/**/*.py', 'backlash_ros/tools/identify/identified_file.py',
           'benchmarks/gears/*.py', 'examples/gear_physics.py')


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


def gear_of(inertia: float, bandwidth: float) -> Gear:
    """A gear like the servo preset, with a motor that is heavy beside the load."""
    base = PRESETS['servo']
    w = 2.0 * pi * base.frequency
    motor, servo = HEAVY_MOTOR * base.load_inertia, bandwidth * w
    return replace(
        base, friction=base.load_inertia * base.swing * w**2 / inertia, viscous=0.0,
        motor_inertia=motor, stiffness=motor * servo**2, damping=2.0 * DAMPED * motor * servo,
        torque_limit=1e6, motor_resolution=RESOLUTION, load_resolution=RESOLUTION,
        reach=HEADROOM * base.swing, rate=HEADROOM * base.swing * w,
    )


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


def map_cells(side: int, processes: int, file: Path = FILE) -> list[Cell]:
    """All cells, by rows of one bandwidth; those that the file holds are not computed again."""
    jobs = [
        (float(inertia), float(bandwidth))
        for bandwidth in np.geomspace(*BANDWIDTH, side) for inertia in np.geomspace(*INERTIA, side)
    ]
    version = _version()
    known = {(one.inertia, one.bandwidth): one for one in _read(file, version)}
    missing = [job for job in jobs if job not in known]
    file.parent.mkdir(exist_ok=True)
    with file.open('a') as out, Pool(processes) as pool:
        computed = pool.imap_unordered(cell, missing)
        for one in tqdm(computed, 'map', len(missing), unit='cell', disable=None):
            out.write(json.dumps({'version': version, **asdict(one)}) + '\n')
            out.flush()
            known[one.inertia, one.bandwidth] = one
    return [known[job] for job in jobs]


def _read(file: Path, version: str) -> Iterator[Cell]:
    for line in file.read_text().splitlines() if file.exists() else ():
        values = json.loads(line)
        if values.pop('version') == version:
            yield Cell(**values)


def _version() -> str:
    """Of all code that a cell depends on."""
    digest = hashlib.sha256()
    for pattern in SOURCES:
        for path in sorted(ROOT.glob(pattern)):
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


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
