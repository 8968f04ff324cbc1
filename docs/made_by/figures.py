"""Regenerates every picture and every number of the documents: `make docs`.

Pictures go to docs/images. Numbers go between the marks
`<!-- name: made by docs/made_by/figures.py -->` and `<!-- end -->` of the pages;
docs/reference/parameters.md is written as a whole.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[2] / 'benchmarks'))

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from reporting import write_between
from tables import TABLES, WITHOUT, parameters_page, simulate

from backlash_ros.core.simulation.run_record import RunRecord, delayed_reference
from backlash_ros.tools import figures as drawn
from backlash_ros.tools.figures import BACKLASH_UNITS, HATS, HUES, TIME_LABEL, curve, label
from backlash_ros.tools.runs.summary import compare_laws, interesting_parts

DOCS = Path(__file__).resolve().parents[1]
IMAGES = DOCS / 'images'
PAGES = [DOCS.parent / 'README.md', *DOCS.rglob('*.md')]
NAMES = ('m', 'c_r', 'c_l')
WITH_COLOUR, WITHOUT_COLOUR = '#0072B2', '#D55E00'
SMALL = {'structure': 'tracking', 'amplitude': '0.2'}
# The gapless observer allows for a disturbance, which is what helps this loop most.
NO_INVERSE = {**WITHOUT, 'estimator.initial.m': '1.3', 'fixed.doubt': '0.5'}
NO_GAP = {'backlash.c_r': '1e-9', 'backlash.c_l': '-1e-9', 'fixed.doubt': '0.0'}
RESTING: dict[str, Any] = {'linewidth': 6.0, 'alpha': 0.22, 'color': HUES['true']}


def draw_result() -> Figure:
    """A worn gear: y without and with compensation, and what the controller has learned."""
    gear = {'amplitude': '0.3'}
    plain = simulate(4.0, {**gear, **WITHOUT}, 'geared_motor.yaml').record
    learned = simulate(4.0, gear, 'geared_motor.yaml').record
    figure = drawn.new_figure(6.4)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.3, 1.0])
    t = learned.column('t')
    curve(upper, t, learned.column('y_m'), HUES['y_m'], 'reference $y_m$', '--')
    curve(upper, t, plain.column('y'), WITHOUT_COLOUR, 'y without compensation', width=1.8)
    curve(upper, t, learned.column('y'), WITH_COLOUR, 'y with this package', width=1.8)
    label(upper, 'Load behind a worn gear', 'angle [rad]')
    drawn.legend_above(upper)
    lower.axhline(1.0, label='truth', **RESTING)
    for name, width in zip(NAMES, (1.4, 2.4, 1.6), strict=True):
        share = learned.column(name) / learned.column(f'true_{name}')
        curve(lower, t, share, HUES[name], f'${HATS[name]}$', drawn.LINE_STYLES[name], width)
    label(lower, 'What is learned from v and y', 'estimate / truth', TIME_LABEL)
    lower.set_ylim(-0.05, 1.15)
    drawn.legend_above(lower)
    return figure


def draw_figure_4() -> Figure:
    """Parameter errors of three laws on the paper's example, as Figure 4 and as shares."""
    figure = drawn.new_figure(6.6)
    grid = np.asarray(figure.subplots(2, 3, sharex=True, sharey='row'))
    for column, law in enumerate(('printed', 'lms', 'moving_horizon')):
        run, (absolute, relative) = simulate(5.0, {'estimator.law': law}).record, grid[:, column]
        t = run.column('t')
        for name in NAMES:
            truth = run.column(f'true_{name}')
            error = truth - run.column(name)
            unit = BACKLASH_UNITS[name].removeprefix('unit of ')
            curve(absolute, t, error, HUES[name], f'${name} - {HATS[name]}$ [{unit}]',
                  drawn.LINE_STYLES[name], 1.8)
            percent = np.maximum(100.0 * np.abs(error / truth), 1e-12)
            curve(relative, t, percent, HUES[name], '', drawn.LINE_STYLES[name], 1.5)
        drawn.zero_line(absolute)
        relative.set_yscale('log')
        relative.set_ylim(1e-6, 1e3)
        label(absolute, f'estimator.law: {law}')
        label(relative, x=TIME_LABEL)
    grid[0][0].set_ylim(-3.0, 3.0)
    label(grid[0][0], y='true minus estimated')
    label(grid[1][0], y='size of the error [%]')
    drawn.legend_below(figure, grid[0][1])
    return figure


def draw_figure_5() -> Figure:
    run = simulate(5.0)
    return drawn.draw_error_curves(compare_laws(run.record, run.parameters)[0])


def draw_loop() -> Figure:
    run = simulate(5.0)
    return drawn.draw_hysteresis(run.record, interesting_parts(run.record)[1])


def draw_uncertain_plant() -> Figure:
    """Errors of the crossings where the true plant is not G: G believed, and the default."""
    figure = drawn.new_figure(6.4)
    grid = np.asarray(figure.subplots(2, 2, sharex=True, sharey='row'))
    kinds = (('plant.uncertainty: 0', '0.0', 50.0), ('default', '0.2', 0.4))
    for line, (name, uncertainty, reach) in zip(grid, kinds, strict=True):
        for axes, scale in zip(line, ('0.8', '1.2'), strict=True):
            change = {'truth.scale_frequency': scale, 'plant.uncertainty': uncertainty}
            _draw_crossing_errors(axes, simulate(6.0, change, 'geared_motor.yaml').record)
            drawn.zero_line(axes)
            axes.set_ylim(-reach, reach)
            label(axes, f'true natural frequency × {scale}, {name}')
        label(line[0], y='error [% of the truth]')
    for axes in grid[1]:
        label(axes, x=TIME_LABEL)
    drawn.legend_below(figure, grid[0][0])
    return figure


def _draw_crossing_errors(axes: Axes, run: RunRecord) -> None:
    """Errors of c_r and c_l in per cent from the first estimate on, and two deviations."""
    t = run.column('t')
    for name in ('c_r', 'c_l'):
        truth, std = run.column(f'true_{name}'), run.column(f'std_{name}')
        # Before the first estimate there is no deviation, and so no curve.
        percent = 100.0 * (run.column(name) - truth + 0.0 * std) / np.abs(truth)
        around = 200.0 * std / np.abs(truth)
        drawn.band(axes, t, percent - around, percent + around, HUES[name],
             '±2 published standard deviations' if name == 'c_r' else '')
        curve(axes, t, percent, HUES[name], f'${HATS[name]}$', drawn.LINE_STYLES[name], 1.6)
    drawn.shade(axes, t, run.column('status') == 4.0, 'frozen: inconsistent')


def draw_recovery() -> Figure:
    """c_r steps from 3 to 4 without a word to the estimator."""
    jump = {'output_noise_std': '1e-3', 'backlash.jump': '[0.0, 1.0, 0.0]',
            'backlash.jump_time': '3.0'}
    run = simulate(5.0, jump).record
    figure = drawn.new_figure(4.0)
    axes = figure.subplots()
    t = run.column('t')
    axes.plot(t, run.column('true_c_r'), label='true', **RESTING)
    curve(axes, t, run.column('c_r'), HUES['c_r'], f'${HATS["c_r"]}$', width=1.8)
    drawn.shade(axes, t, run.column('status') == 4.0, 'frozen: inconsistent')
    label(axes, '$c_r$ steps from 3 to 4', f'[{BACKLASH_UNITS["c_r"]}]', TIME_LABEL)
    drawn.legend_above(axes)
    axes.set_ylim(0.0, 4.5)
    return figure


def draw_tracking() -> Figure:
    """Output and tracking error of `structure: tracking` on the paper's plant."""
    loops = {
        'no compensation': (simulate(6.0, {**SMALL, **NO_INVERSE}), WITHOUT_COLOUR, '-'),
        'adaptive inverse': (simulate(6.0, SMALL), WITH_COLOUR, '-'),
        'no backlash': (simulate(6.0, {**SMALL, **NO_INVERSE, **NO_GAP}), '#000000', '--'),
    }
    figure = drawn.new_figure(6.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for name, (run, colour, style) in loops.items():
        t, reference = run.record.column('t'), delayed_reference(run.record, run.delay)
        curve(upper, t, run.record.column('y'), colour, f'y, {name}', style)
        error = np.abs(run.record.column('y') - reference) / float(np.abs(reference).max())
        curve(lower, t, np.maximum(error, 1e-9), colour, name, style)
    curve(upper, t, reference, HUES['y_m'], '$y_m$, delayed', ':', 2.4)
    lower.set_yscale('log')
    lower.set_ylim(1e-7, 10.0)
    lower.set_xlim(0.0, 4.0)
    label(upper, 'Output', '[unit of y]')
    label(lower, 'Distance from the delayed reference', 'share of the amplitude', TIME_LABEL)
    drawn.legend_above(upper)
    drawn.legend_above(lower)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    'result': draw_result, 'figure_4': draw_figure_4, 'figure_5': draw_figure_5,
    'hysteresis': draw_loop, 'recovery': draw_recovery, 'tracking': draw_tracking,
    'uncertain_plant': draw_uncertain_plant}


def main() -> None:
    IMAGES.mkdir(exist_ok=True)
    for name, draw in FIGURES.items():
        (IMAGES / f'{name}.png').write_bytes(drawn.png(draw()))
    (DOCS / 'reference' / 'parameters.md').write_text(parameters_page())
    for page in PAGES:
        for name, table in TABLES.items():
            if f'<!-- {name}: made by docs/made_by/figures.py -->' in page.read_text():
                write_between(page, name, table())


if __name__ == '__main__':
    main()
