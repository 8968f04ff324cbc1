"""Gears made of physics: how much of the error that backlash makes is removed, from limits alone.

`python benchmarks/physics.py` identifies each preset of examples/gear_physics.py, closes the loop
with what was found for five motions, and prints tables; `--write` puts them and a figure into
docs/physics.md. `--preset robot --motion triangle`: one case.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections import Counter
from math import isinf, isnan, nan
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')

from gears.gear_figures import draw_hysteresis
from gears.gear_runs import (
    MOTIONS,
    PRESETS,
    Identified,
    close_loop,
    identified,
    inertia,
    lost_motion,
    quasi_static,
    uncompensated,
)
from reporting import ROOT, machine, markdown_table, parallel, processors, text_table

from backlash_ros.core.estimate import Status

DOCUMENT = ROOT / 'docs' / 'physics.md'
IMAGES = ROOT / 'docs' / 'images'
MARKS = re.compile(r'(<!-- physics: made by benchmarks -->\n).*?(<!-- end -->)', re.DOTALL)
REMOVED, OFF = 0.9, 0.1  # bounds: share that is removed, error of the gap under *tracking*


class Source(NamedTuple):
    """One way to know v: the command, or the motor encoder. lost: motion lost behind it."""

    preset: str
    encoder: bool
    lost: float
    identified: Identified


class Loop(NamedTuple):
    """A loop that learns: its error, gap over lost motion, worst of it under *tracking*, states."""

    error: float
    gap: float
    tracking_off: float
    states: str


class Case(NamedTuple):
    """One motion of one preset. none: error without compensation."""

    preset: str
    motion: str
    lost: float
    none: float
    loops: tuple[Loop, Loop]  # from the command, from the motor encoder

    def removed(self, loop: Loop) -> float:
        """Share of the error that is removed."""
        return (self.none - loop.error) / self.none


def find(job: tuple[str, bool]) -> Source:
    """Identify one preset."""
    preset, encoder = job
    v, motor, load = quasi_static(PRESETS[preset])
    return Source(
        preset, encoder, lost_motion(motor if encoder else v, load),
        identified(PRESETS[preset], encoder),
    )


def judge(job: tuple[str, Source, Source]) -> Case:
    """All loops of one motion."""
    motion, command, encoder = job
    gear, parameters = PRESETS[command.preset], command.identified.parameters
    none = nan if parameters is None else uncompensated(gear, parameters, motion).error
    return Case(
        command.preset, motion, command.lost, none, (_loop(command, motion), _loop(encoder, motion))
    )


def _loop(source: Source, motion: str) -> Loop:
    one = source.identified
    if one.parameters is None:
        return Loop(nan, nan, nan, one.refused)
    try:
        run = close_loop(PRESETS[source.preset], one.controller, motion, source.encoder)
    except (ArithmeticError, ValueError) as error:
        return Loop(nan, nan, nan, str(error))
    shares = Counter(run.status[run.first:].tolist())
    return Loop(
        run.error, float(run.gap[-1]) / source.lost, run.said_tracking_off_by(source.lost),
        ', '.join(f'{Status(state).word} {count / shares.total():.0%}'
                  for state, count in shares.most_common()),
    )


FOUND_HEADER = ('preset', 'v from', 'gap', 'lost motion, measured', 'gap found / lost motion',
                'identify says')


def found_rows(sources: list[Source]) -> list[list[str]]:
    """What identification finds."""
    rows = []
    for one in sources:
        gear, found = PRESETS[one.preset], one.identified.found
        said = f'{one.identified.said} {one.identified.option and f"({one.identified.option})"}'
        rows.append([
            one.preset, 'motor encoder' if one.encoder else 'command',
            f'{gear.scale * gear.gap:.4g}', f'{one.lost:.4g}',
            f'{found.gap / one.lost:.3f} ± {found.std.get("gap", nan) / one.lost:.2g}',
            said.strip(),
        ])
    return rows


HEADER = ('preset', 'motion', 'J\\|a\\|/τ_c', 'coasts', 'none', 'command: error', 'removed',
          'gap', 'states', 'encoder: error', 'removed', 'gap', 'states')


def rows_of(cases: list[Case]) -> list[list[str]]:
    """Errors in % of the lost motion; gaps over the lost motion."""
    rows = []
    for one in cases:
        gear = PRESETS[one.preset]
        ratio, coasts = inertia(gear, one.motion)
        row = [one.preset, one.motion, 'jumps' if isinf(ratio) else f'{ratio:.2g}',
               f'{coasts:.2g}', f'{one.none / one.lost:.1%}']
        for loop in one.loops:
            row += [f'{loop.error / one.lost:.1%}', f'{one.removed(loop):.0%}', f'{loop.gap:.3f}',
                    loop.states]
        rows.append(row)
    return rows


def wrong(cases: list[Case]) -> list[list[str]]:
    """Where a bound is missed, with the command that shows it."""
    rows = []
    for one in cases:
        for name, loop in zip(('command', 'motor encoder'), one.loops, strict=True):
            what = []
            if not one.removed(loop) >= REMOVED:
                what.append(loop.states if isnan(loop.error)
                            else f'removes {one.removed(loop):.0%}')
            if loop.tracking_off > OFF:
                what.append(f'says tracking with the gap off by {loop.tracking_off:.0%}')
            if what:
                rows.append([
                    f"`benchmarks/physics.py --preset {one.preset} --motion '{one.motion}'`",
                    name, '; '.join(what),
                ])
    return rows


def main() -> None:
    """Measure and print, or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--preset', action='append', choices=PRESETS)
    parser.add_argument('--motion', action='append', choices=MOTIONS)
    parser.add_argument('--processes', type=int, default=processors(), metavar='N',
                        help='that compute beside each other')
    parser.add_argument('--write', action='store_true', help=f'write into {DOCUMENT.name}')
    options = parser.parse_args()
    presets, motions = options.preset or list(PRESETS), options.motion or list(MOTIONS)
    sources = parallel(
        find, [(preset, encoder) for preset in presets for encoder in (False, True)],
        'identification', options.processes,
    )
    cases = parallel(
        judge, [(motion, *sources[2 * i:2 * i + 2])
                for i in range(len(presets)) for motion in motions], 'loops', options.processes,
    )
    found, rows, bad = found_rows(sources), rows_of(cases), wrong(cases)
    header = ('run', 'v from', 'what')
    print(text_table(FOUND_HEADER, found))
    print(text_table(HEADER, rows))
    print(text_table(header, bad))
    if options.write:
        draw_hysteresis(IMAGES / 'physics.png')
        text = '\n\n'.join([
            markdown_table(FOUND_HEADER, found), markdown_table(HEADER, rows),
            f'Where less than {REMOVED:.0%} is removed, or *tracking* is said with the gap off by '
            f'more than {OFF:.0%}, on {machine()}:', markdown_table(header, bad),
        ])
        page = DOCUMENT.read_text()
        DOCUMENT.write_text(MARKS.sub(lambda mark: f'{mark[1]}{text}\n{mark[2]}', page))


if __name__ == '__main__':
    sys.exit(main())
