"""`compare`: run every law and structure on one scenario; write a figure, a table, a document."""

import argparse
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from string import Template
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.assembly import build_model
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation import run_record
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.options import OptionParser
from backlash_ros.tools import cli
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.runs.files import result_directory, results_folder
from backlash_ros.tools.runs.read_run import run_loop
from backlash_ros.topics import BACKLASH

COMPARISON_HEADER = (
    'loop', 'control error', 'tracking error', 'backlash penalty', 'total variation of v',
    'crossings per reversal',
)
# As good as no gap at all; definition (2.1) needs one.
GAPLESS = {'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9}


class Result(NamedTuple):
    """Result of one loop. merits: cells of the table. note: why the run broke off, if it did.

    delay: samples by which y is to follow y_m, None if it is not meant to follow.
    """

    name: str
    merits: tuple[float | None, ...] = (None,) * (len(COMPARISON_HEADER) - 1)
    run: RunRecord | None = None
    delay: int | None = None
    note: str = ''


def contenders(scenario: Parameters) -> dict[str, Parameters]:
    """Parameters of the loops by name, from the paper's to the one without a backlash."""
    m, c_r, c_l = (getattr(scenario.backlash, name) for name in BACKLASH)
    # Saved estimates would favour the law that learned them.
    paper = scenario.replaced({'structure': 'proportional', 'estimates.load': False})
    # y_m is scaled by |G| at its frequency, so that every loop demands the same motion of G.
    z = np.exp(1j * scenario.frequency * scenario.sample_period)
    gain = abs(complex(build_model(scenario).response(np.array([z]))[0]))
    tracking = paper.replaced({'structure': 'tracking', 'amplitude': gain * scenario.amplitude,
                               'bias': gain * scenario.bias})
    doubtful = tracking.replaced({'fixed.doubt': 0.5})
    return {
        **{f'{law}, u_d = y_m + f v': paper.replaced({'estimator.law': law})
           for law in ('printed', 'lms', 'moving_horizon')},
        'gradient, four blocks': tracking.replaced({
            'structure': 'pole_placement', 'estimator.law': 'gradient',
            # A smaller weight needs a less noisy y, which these blocks feed back unfiltered.
            'tracking.input_weight': 1.0,
        }),
        'moving_horizon, tracking': tracking.replaced({'estimator.law': 'moving_horizon'}),
        'wrong constants, tracking': _fixed(doubtful, m, 1.3 * c_r, 1.3 * c_l),
        'no compensation, tracking': _fixed(doubtful, m),
        'no backlash, tracking': _fixed(tracking.replaced(GAPLESS), m),
    }


def _fixed(p: Parameters, m: float, c_r: float = 0.0, c_l: float = 0.0) -> Parameters:
    return p.replaced({'estimator.law': 'fixed', 'estimator.initial.m': m,
                       'estimator.initial.c_r': c_r, 'estimator.initial.c_l': c_l})


def compare(scenario: Parameters, samples: int) -> list[Result]:
    bar = tqdm(contenders(scenario).items(), desc='compare', unit='loop', disable=None)
    return [_measure(name, p, samples) for name, p in bar]


def _measure(name: str, p: Parameters, samples: int) -> Result:
    loop = build_closed_loop(p)
    delay = None if p.structure == 'proportional' else loop.controller.structure.delay
    try:
        run = run_loop(loop, samples)
    except cli.BrokenOffError as broken:
        return Result(name, note=str(broken))
    since = 0.2 * run.samples * run.sample_period
    error = penalty = None
    if delay is not None:
        gapless = run_loop(build_closed_loop(_fixed(
            p.replaced({**GAPLESS, 'fixed.doubt': 0.0}), p.backlash.m)), samples)
        error, best = (run_record.delayed_tracking_error_rms(each, delay, since)
                       for each in (run, gapless))
        penalty = None if error is None or best is None else error - best
    return Result(name, (
        run_record.control_error_rms(run), error, penalty,
        float(np.abs(np.diff(run.column('v')[run.column('t') >= since])).sum()),
        run_record.gap_crossings_per_reversal(run, since),
    ), run, delay)


def make_parser() -> argparse.ArgumentParser:
    return cli.add_options(OptionParser('compare', description=__doc__), '--config', '--set',
                           '--axis', '--seed', '--out', '--duration')


def _compare(args: Sequence[str] | None) -> None:
    options = make_parser().parse_args(args)
    configuration = read_configuration(options.config, options.settings, options.seed)
    scenario = configuration.parameters(options.axis)
    samples = cli.number_of_samples(scenario, options.duration)
    results_folder(options.out)
    results = compare(scenario, samples)
    # Imported here, as drawing libraries take a second to load.
    from backlash_ros.tools.figures import draw_error_curves, png
    rows = [(each.name, *(cli.number(merit, 3) for merit in each.merits)) for each in results]
    print(cli.format_table(COMPARISON_HEADER, rows))
    out = result_directory(options.out)
    figure, document = 'images/comparison.png', out / 'comparison.md'
    (out / figure).parent.mkdir(parents=True, exist_ok=True)
    runs = {each.name: each.run for each in results if each.run is not None}
    delays = {each.name: each.delay for each in results if each.delay is not None}
    write_atomically(out / figure, png(draw_error_curves(runs, delays)))
    template = Template(Path(__file__).with_name('comparison.md').read_text(encoding='utf-8'))
    numbers = {name: f'{getattr(scenario.backlash, name):g}' for name in BACKLASH}
    write_atomically(document, template.substitute(
        numbers, frequency=f'{scenario.frequency:g}', noise=f'{scenario.output_noise_std:g}',
        figure=figure, waveform=scenario.waveform, header=' | '.join(COMPARISON_HEADER),
        rule='|---' * len(COMPARISON_HEADER),
        rows='\n'.join(f'| {" | ".join(row)} |' for row in rows),
        notes=''.join(f'- {result.name}: {result.note}.\n' for result in results if result.note)))
    print(f'document: {document}')


main = partial(cli.run_tool, 'compare', _compare)

if __name__ == '__main__':
    sys.exit(main())
