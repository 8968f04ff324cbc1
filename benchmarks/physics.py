"""Gears made of physics: how much of the error that backlash makes is removed, from limits alone.

`python benchmarks/physics.py` identifies each preset of examples/gear_physics.py, closes the loop
with what was found for five motions, then with G alone, so that the gap is learned from nothing,
and prints tables; `--write` puts them and a figure into docs/physics.md.
`--preset robot --motion triangle`: one case.
"""

import argparse
import os
from collections import Counter
from itertools import product
from math import isinf, nan
from typing import NamedTuple

os.environ.setdefault('OMP_NUM_THREADS', '1')

from gears import gear_runs
from gears.gear_runs import MOTIONS, PRESETS, Identified
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from reporting import (
    ROOT,
    format_table,
    machine,
    markdown_table,
    parallel,
    processors,
    write_between,
)

from backlash_ros.core import Status, build_controller

DOCUMENT = ROOT / 'docs' / 'physics.md'
REMOVED, OFF = 0.9, 0.1  # bounds: share that is removed, error of the gap under *tracking*
FROM = ('command', 'motor encoder')  # that v is known from
GUESS = 1.0 / 3.0  # first guess of the gap over the lost motion where only G is given


class Source(NamedTuple):
    """One way to know v: the command, or the motor encoder. lost: motion lost behind it."""

    preset: str
    encoder: bool
    lost: float
    identified: Identified


class Loop(NamedTuple):
    """A loop that learns: its error and the share that is removed of the error without
    compensation, gap over lost motion, worst of it under *tracking*, states or why there is none.
    """

    error: float
    removed: float
    gap: float
    tracking_off: float
    states: str


class Case(NamedTuple):
    """One motion of one preset. none: error without compensation. loops, alone: as FROM, with all
    that was identified, and with G alone.
    """

    preset: str
    motion: str
    lost: float
    none: float
    loops: list[Loop]
    alone: list[Loop]


def find(job: tuple[str, bool]) -> Source:
    preset, encoder = job
    v, motor, load = gear_runs.quasi_static(PRESETS[preset])
    return Source(preset, encoder, gear_runs.lost_motion(motor if encoder else v, load),
                  gear_runs.identified(PRESETS[preset], encoder))


def judge(job: tuple[str, Source, Source]) -> Case:
    motion, *sources = job
    command, parameters = sources[0], sources[0].identified.parameters
    none = nan if parameters is None else gear_runs.uncompensated(
        PRESETS[command.preset], parameters, motion).error
    return Case(command.preset, motion, command.lost, none,
                [_loop(source, motion, none) for source in sources],
                [_loop(source, motion, none, GUESS) for source in sources])


def _loop(source: Source, motion: str, none: float, guess: float | None = None) -> Loop:
    """guess: of the gap, over the lost motion; None for what was identified."""
    one = source.identified
    if one.parameters is None:
        return Loop(nan, nan, nan, nan, one.refused)
    if guess is None:
        controller = one.controller
    else:
        c_r = 0.5 * guess * source.lost
        controller = build_controller(one.parameters.replaced(
            {'estimator.initial.c_r': c_r, 'estimator.initial.c_l': -c_r}))
    try:
        run = gear_runs.close_loop(PRESETS[source.preset], controller, motion, source.encoder)
    except (ArithmeticError, ValueError) as error:
        return Loop(nan, nan, nan, nan, str(error))
    shares = Counter(run.status[run.first:].tolist())
    return Loop(
        run.error, (none - run.error) / none, float(run.gap[-1]) / source.lost,
        run.said_tracking_off_by(source.lost),
        ', '.join(f'{Status(state).word} {count / shares.total():.0%}'
                  for state, count in shares.most_common()),
    )


FOUND_HEADER = ('preset', 'v from', 'gap', 'lost motion, measured', 'gap found / lost motion',
                'identify says')


def found_row(one: Source) -> list[str]:
    gear, (found, option, _, refused) = PRESETS[one.preset], one.identified
    said = f'refused: {refused}' if refused else '; '.join(found.reasons) or 'of use'
    said += f' ({option})' if option else ''
    return [
        one.preset, FROM[one.encoder], f'{gear.scale * gear.gap:.4g}', f'{one.lost:.4g}',
        f'{found.gap / one.lost:.3f} ± {found.std.get("gap", nan) / one.lost:.2g}', said,
    ]


HEADER = ('preset', 'motion', 'J\\|a\\|/τ_c', 'coasts', 'none', 'command: error', 'removed',
          'gap', 'states', 'encoder: error', 'removed', 'gap', 'states')


def row_of(one: Case) -> list[str]:
    """Errors in % of the lost motion; gaps over the lost motion."""
    ratio, coasts = gear_runs.inertia(PRESETS[one.preset], one.motion)
    row = [one.preset, one.motion, 'jumps' if isinf(ratio) else f'{ratio:.2g}', f'{coasts:.2g}',
           f'{one.none / one.lost:.1%}']
    for loop in one.loops:
        row += [f'{loop.error / one.lost:.1%}', f'{loop.removed:.0%}', f'{loop.gap:.3f}',
                loop.states]
    return row


ALONE_HEADER = ('preset', 'motion', *(name for v in FROM for name in (
    f'{v}: removed', 'gap', 'off while tracking', 'states')))


def alone_row(one: Case) -> list[str]:
    row = [one.preset, one.motion]
    for loop in one.alone:
        row += [f'{loop.removed:.0%}', f'{loop.gap:.3f}', f'{loop.tracking_off:.1%}', loop.states]
    return row


def wrong(cases: list[Case]) -> list[list[str]]:
    rows = []
    for one in cases:
        for name, loop in zip(FROM, one.loops, strict=True):
            less = loop.states if loop.error != loop.error else f'removes {loop.removed:.1%}'
            off = f'says tracking with the gap off by {loop.tracking_off:.0%}'
            what = [less] * (not loop.removed >= REMOVED) + [off] * (loop.tracking_off > OFF)
            if what:
                command = f"benchmarks/physics.py --preset {one.preset} --motion '{one.motion}'"
                rows.append([f'`{command}`', name, '; '.join(what)])
    return rows


def draw_hysteresis() -> Figure:
    figure = Figure(figsize=(15, 6), layout='constrained')
    axes = figure.subplots(2, len(PRESETS))
    for (above, below), (name, gear) in zip(axes.T, PRESETS.items(), strict=True):
        v, motor, load = gear_runs.quasi_static(gear)
        for x, label in ((v, 'command'), (motor, 'motor')):
            above.plot(x, load, label=label)
            below.plot(x, x - load)
        for side in (-0.5, 0.5):
            below.axhline(side * gear.scale * gear.gap, color='0.6', linestyle=':', zorder=0)
        above.set_title(name)
        below.set_xlabel('v [mm]' if gear.linear else 'v [rad]')
    axes[0, 0].set_ylabel('load')
    axes[1, 0].set_ylabel('v − load; gap dotted')
    axes[0, 0].legend()
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--preset', action='append', choices=PRESETS)
    parser.add_argument('--motion', action='append', choices=MOTIONS)
    parser.add_argument('--processes', type=int, default=processors(), metavar='N',
                        help='that compute beside each other')
    parser.add_argument('--write', action='store_true', help=f'write into {DOCUMENT.name}')
    options = parser.parse_args()
    presets, motions = options.preset or list(PRESETS), options.motion or list(MOTIONS)
    sources = parallel(
        find, list(product(presets, (False, True))), 'identification', options.processes)
    pairs = list(zip(sources[::2], sources[1::2], strict=True))
    cases = parallel(judge, [(motion, *pair) for pair in pairs for motion in motions], 'loops',
                     options.processes)
    tables = ((FOUND_HEADER, list(map(found_row, sources))), (HEADER, list(map(row_of, cases))),
              (('run', 'v from', 'what'), wrong(cases)),
              (ALONE_HEADER, list(map(alone_row, cases))))
    for table in tables:
        print(format_table(*table))
    if options.write:
        FigureCanvasAgg(figure := draw_hysteresis())
        figure.savefig(ROOT / 'docs' / 'images' / 'physics.png', dpi=80)
        found, loops, bad, alone = (markdown_table(*table) for table in tables)
        write_between(DOCUMENT, 'physics', '\n\n'.join([
            found, loops, f'Where less than {REMOVED:.0%} is removed, or *tracking* is said with '
            f'the gap off by more than {OFF:.0%}, on {machine()}:', bad]))
        write_between(DOCUMENT, 'physics, G alone', alone)


if __name__ == '__main__':
    main()
