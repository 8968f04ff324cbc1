"""The figure and the document that `compare` writes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.compare.comparison import HEADER, Result, row, tracking_deviation
from backlash_ros.tools.pages.drawing import curve, label, limit_decades, new_figure
from backlash_ros.tools.report.analysis import moving_rms

# Okabe-Ito, told apart with every kind of colour vision.
LOOK = (
    ('#999933', '-'), ('#AA4499', '--'), ('#44AA99', '-.'), ('#0072B2', '-'),
    ('#D55E00', '-'), ('#E69F00', '--'), ('#555555', ':'), ('#000000', '-'),
)
DECADES = 9.0  # of an axis with errors, at most
WINDOW_S = 0.5  # over which the error of a curve is averaged


def draw_comparison(results: Sequence[Result]) -> Figure:
    """Size of the control error (Figure 5 of the paper, extended) and of the tracking error."""
    figure = new_figure(8.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    drawn: dict[int, list[float]] = {0: [], 1: []}
    for result, (colour, style) in zip(results, LOOK, strict=True):
        run = result.run
        if run is None:
            continue
        t, samples = run.column('t'), max(round(WINDOW_S / run.sample_period), 1)
        control = moving_rms(run.column('u') - run.column('u_d'), samples)
        deviation = tracking_deviation(result)
        for place, axes, size in (
            (0, upper, control),
            (1, lower, None if deviation is None else moving_rms(deviation, samples)),
        ):
            if size is None:
                continue
            shown = np.where(size > 0.0, size, np.nan)
            name = result.contender.name if place == 0 else ''
            # Wide, as another curve comes to lie on it.
            width = 3.4 if result.contender.name == 'moving_horizon, tracking' else 1.7
            curve(axes, t, shown, colour, name, style, width)
            axes.set_xlim(0.0, float(t[-1]))
            drawn[place] += shown[np.isfinite(shown)].tolist()
    for place, axes in ((0, upper), (1, lower)):
        if drawn[place]:
            low, high = np.percentile(drawn[place], [2, 100])
            limit_decades(axes, float(low), float(high), DECADES)
    label(upper, 'Control error', f'RMS of $u - u_d$ over {WINDOW_S:g} s\n[unit of u]')
    label(lower, 'Tracking error, where y is meant to follow',
          f'RMS of $y - y_m$ over {WINDOW_S:g} s\n[unit of y]', 'time t [s]')
    figure.legend(loc='outside lower center', ncol=3, frameon=False)
    return figure


def comparison_document(
    scenario: Parameters, results: Sequence[Result], figure: str,
) -> str:
    """docs/results/comparison.md as text."""
    lines = [
        '# Comparison of laws and structures', '',
        f'![Control error and tracking error of every loop over time]({figure})', '',
        '| ' + ' | '.join(HEADER) + ' |', '|---' * len(HEADER) + '|',
        *('| ' + ' | '.join(row(result)) + ' |' for result in results), '',
    ]
    lines += [f'- {result.contender.name}: {result.note}.' for result in results if result.note]
    noise = scenario.get_float('output_noise_std')
    lines += [
        f'Scenario: the plant of the configuration, m = {scenario.get_float("backlash.m"):g}, '
        f'c_r = {scenario.get_float("backlash.c_r"):g}, '
        f'c_l = {scenario.get_float("backlash.c_l"):g}, '
        f'{scenario.get_str("waveform")} at {scenario.get_float("frequency"):g} rad/s, '
        f'noise on y with standard deviation {noise:g}. Written by `compare --out docs`; '
        'do not edit.',
        '',
        "- In the paper's structure y_m sets u_d, elsewhere y follows y_m scaled by |G| at its "
        'frequency: every loop asks for about the same motion.',
        '- Control error: RMS of u - u_d over the last second. Tracking error: relative RMS of '
        'y - y_m with y_m delayed as the structure says, without the first fifth of the run. '
        'Backlash penalty: what is left of it when the error of the same structure on a plant '
        'without backlash is subtracted.',
        '- Total variation of v: sum of |v(k) - v(k-1)| without the first fifth. Crossings: how '
        'often v turns back by more than half of the gap, for each reversal of y_m.',
        '- Time: median of one step of the controller on the machine that wrote this.',
        '- No compensation and wrong constants (the crossings 30 % too large) know the slope, '
        'and have an observer that allows for a disturbance of u.',
        '',
    ]
    return '\n'.join(lines)
