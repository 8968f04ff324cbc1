"""The figures of a report; each function draws what analysis.py has computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from backlash_ros.core.simulation.metrics import SETTLING_TOLERANCE
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.pages.drawing import (
    COLOURS,
    ESTIMATES,
    LAW_COLOURS,
    OTHER_LAW,
    STYLES,
    TIME,
    UNITS,
    band,
    curve,
    label,
    legend_above,
    legend_below,
    limit_decades,
    limits,
    new_figure,
    plain_numbers,
    shade,
    zero_line,
)
from backlash_ros.tools.report.analysis import (
    FollowedReference,
    LawTrace,
    Part,
    control_error,
    estimated_loop,
    frozen,
)
from backlash_ros.topics import BACKLASH

Array = NDArray[np.float64]

WHOLE = Part('Whole run', slice(None))
DECADES = 8.0  # that a logarithmic axis shows at most: what is below them is as good as zero


def draw_parameter_errors(
    run: RunRecord, start: Part, settling: Mapping[str, float | None],
) -> Figure:
    """Errors of the estimates over time, as Figure 4 of the paper, and their relative size."""
    figure = new_figure(7.4)
    rows = figure.add_gridspec(2, 1, height_ratios=[1.0, 0.01])
    grid = np.asarray(rows[0].subgridspec(2, 2).subplots(sharex='col', sharey='row'))
    for column, part in enumerate((start, WHOLE)):
        absolute, relative = grid[0][column], grid[1][column]
        _draw_absolute_errors(absolute, run, part)
        _draw_relative_errors(relative, run, part, settling)
        label(absolute, part.name)
        label(relative, x=TIME)
    label(grid[0][0], y='true minus estimated')
    label(grid[1][0], y='size of the error [% of the true value]')
    legend_below(figure.add_subplot(rows[1]), grid[0][1])
    return figure


def _draw_absolute_errors(axes: Axes, run: RunRecord, part: Part) -> None:
    t = run.column('t')[part.rows]
    for name in BACKLASH:
        error = (run.column(f'true_{name}') - run.column(name))[part.rows]
        std = run.column(f'std_{name}')[part.rows]
        unit = UNITS[name].removeprefix('unit of ')
        curve(axes, t, error, COLOURS[name], f'${name} - {ESTIMATES[name]}$ [{unit}]',
              STYLES[name], 1.8)
        band(axes, t, error - 2 * std, error + 2 * std, COLOURS[name])
    shade(axes, t, frozen(run)[part.rows], 'frozen')
    zero_line(axes)
    everything = [run.column(f'true_{name}') - run.column(name) for name in BACKLASH]
    axes.set_ylim(*limits(everything, margin=0.08))


def _draw_relative_errors(
    axes: Axes, run: RunRecord, part: Part, settling: Mapping[str, float | None],
) -> None:
    t = run.column('t')[part.rows]
    percent = {}
    for name in BACKLASH:
        truth = run.column(f'true_{name}')
        # Nothing is a percentage of zero, and the logarithm has no zero.
        truth = np.where(truth == 0.0, np.nan, truth)
        percent[name] = np.maximum(100.0 * np.abs(1.0 - run.column(name) / truth), 1e-300)
        curve(axes, t, percent[name][part.rows], COLOURS[name], '', STYLES[name], 1.5)
        settled = settling[name]
        if settled is not None and settled <= t[-1]:
            axes.plot(
                settled, 100.0 * SETTLING_TOLERANCE, 'o', color=COLOURS[name], markersize=7,
                markeredgecolor='white', zorder=5,
            )
    axes.axhline(100.0 * SETTLING_TOLERANCE, color='#444444', linewidth=0.9, linestyle=':')
    known = np.concatenate([values[np.isfinite(values)] for values in percent.values()])
    if known.size:
        limit_decades(axes, min(float(known.min()), 0.5), max(float(known.max()), 2.0), DECADES)


def draw_estimates(run: RunRecord) -> Figure:
    """Estimates over time with two standard deviations, and the truth where it is known."""
    figure = new_figure(7.0)
    t = run.column('t')
    for axes, name in zip(figure.subplots(3, 1, sharex=True), BACKLASH, strict=True):
        estimate, std = run.column(name), run.column(f'std_{name}')
        title = f'${ESTIMATES[name]}$ = {estimate[-1]:.6g}'
        if run.has_truth:
            curve(axes, t, run.column(f'true_{name}'), COLOURS['true'], 'true', width=6.0,
                  alpha=0.22)
        curve(axes, t, estimate, COLOURS[name], 'estimated', width=1.8)
        if np.isfinite(std).any():
            band(axes, t, estimate - 2 * std, estimate + 2 * std, COLOURS[name],
                 '±2 standard deviations')
            # The first, nearly boundless uncertainty would flatten everything else.
            # The margin is for the standard deviations.
            axes.set_ylim(*limits([estimate, run.column(f'true_{name}')], 0.25))
            title += f' ± {2 * std[-1]:.2g}'
        shade(axes, t, frozen(run), 'frozen')
        label(axes, f'{title} at the end', f'${ESTIMATES[name]}$ [{UNITS[name]}]')
        legend_above(axes)
    label(axes, x=TIME)
    return figure


def draw_control_error(run: RunRecord, parts: Sequence[Part]) -> Figure:
    """Control error e = u - u_d (3.4) over the whole run, and closer at its start and end."""
    figure = new_figure(5.6)
    grid = figure.add_gridspec(2, len(parts))
    panels = [(figure.add_subplot(grid[0, :]), WHOLE)]
    panels += [(figure.add_subplot(grid[1, i]), part) for i, part in enumerate(parts)]
    for axes, part in panels:
        curve(axes, run.column('t')[part.rows], control_error(run)[part.rows], COLOURS['e'])
        zero_line(axes)
        plain_numbers(axes)
        label(axes, part.name, '$u - u_d$ [unit of u]', '' if part is WHOLE else TIME)
    return figure


def draw_laws(traces: Sequence[LawTrace], start: Part) -> Figure:
    """Control errors of the laws, as Figure 5 of the paper: each alone, then their size."""
    figure = new_figure(1.7 * len(traces) + 3.4)
    grid = figure.subplots(
        len(traces) + 1, 2, sharex='col', height_ratios=[1.0] * len(traces) + [1.7]
    )
    for column, part in enumerate((start, WHOLE)):
        for axes, trace in zip(grid[:-1, column], traces, strict=True):
            curve(axes, trace.t[part.rows], trace.e[part.rows],
                  LAW_COLOURS.get(trace.law, OTHER_LAW))
            zero_line(axes)
            axes.text(0.5, 0.5, fill(trace.note, 50), transform=axes.transAxes, ha='center',
                      va='center', fontsize=9)
            label(axes, part.name if axes is grid[0][column] else '')
        _draw_sizes(grid[-1][column], traces, part)
    for axes, trace in zip(grid[:-1, 0], traces, strict=True):
        origin = 'this run' if trace.recorded else 'simulated'
        label(axes, y=f'{trace.law}\n({origin})\n$u - u_d$ [unit of u]')
    figure.align_ylabels(grid[:, 0])
    label(grid[-1][0], y='RMS of $u - u_d$\nover one period\n[unit of u]')
    legend_above(grid[-1][1])
    return figure


def _draw_sizes(axes: Axes, traces: Sequence[LawTrace], part: Part) -> None:
    for trace, style in zip(traces, ('-', '--', '-.', ':') * len(traces), strict=False):
        size = np.where(trace.rms > 0.0, trace.rms, np.nan)
        curve(axes, trace.t[part.rows], size[part.rows], LAW_COLOURS.get(trace.law, OTHER_LAW),
              trace.law, style, 1.8)
    sizes = [trace.rms[np.isfinite(trace.rms) & (trace.rms > 0.0)] for trace in traces]
    # A law that diverges leaves the axes, which are made for those that do not.
    highest = [float(size.max()) for size in sizes if size.size]
    if highest:
        top = min(max(highest), 1e3 * min(highest))
        # Not the least of all: an error begins at zero.
        low = float(np.percentile(np.concatenate(sizes), 2))
        limit_decades(axes, low, top, DECADES)
    label(axes, x=TIME)


def draw_hysteresis(run: RunRecord, end: Part) -> Figure:
    """v-u loop at the end of the run with the true and the estimated lines."""
    figure = new_figure(6.0)
    axes = figure.subplots()
    v, truth = run.column('v'), run.has_truth
    u = run.column('u') if truth else estimated_loop(run)
    v_low, v_high = limits([v[end.rows]], margin=0.15)
    span = np.array([v_low, v_high])
    for name, side in (('c_r', 'right'), ('c_l', 'left')):
        m, c = run.column('m')[-1], run.column(name)[-1]
        if truth:
            true_m, true_c = run.column('true_m')[-1], run.column(f'true_{name}')[-1]
            axes.plot(
                span, true_m * (span - true_c), color=COLOURS[name], linewidth=6, alpha=0.35,
                label=f'true {side} line\n$m(v - {name})$',
            )
        axes.plot(
            span, m * (span - c), color=COLOURS[name], linewidth=1.6, linestyle='--',
            label=f'estimated {side} line\n${ESTIMATES["m"]}(v - {ESTIMATES[name]})$',
        )
    axes.plot(v, u, color='#999999', linewidth=0.8, zorder=1, label='earlier')
    t = run.column('t')[end.rows]
    axes.plot(
        v[end.rows], u[end.rows], color=COLOURS['u'], linewidth=1.1, marker='.', markersize=3,
        label=f'samples from\n{t[0]:.4g} s to {t[-1]:.4g} s',
    )
    axes.set_xlim(v_low, v_high)
    axes.set_ylim(*limits([u[end.rows]], margin=0.25))
    label(axes, 'u = B[v]' if truth else 'u = B[v] as the last estimates see it',
          'u [unit of u]', 'control v [unit of v]')
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=10,
                labelspacing=1.0)
    return figure


def draw_output(run: RunRecord, end: Part, reference: FollowedReference) -> Figure:
    """Reference and output: on one scale where y follows, else each on its own."""
    figure = new_figure(5.6)
    t, y = run.column('t'), run.column('y')
    grid = figure.subplots(2, 2, sharex='col')
    late = f', {reference.delay:.4g} s late' if reference.delay else ''
    lower_signal = y - reference.values if reference.followed else y
    for column, part in enumerate((WHOLE, end)):
        upper, lower = grid[0][column], grid[1][column]
        curve(upper, t[part.rows], reference.values[part.rows], COLOURS['y_m'], f'$y_m${late}',
              '--' if reference.followed else '-')
        curve(lower, t[part.rows], lower_signal[part.rows], COLOURS['y'])
        if reference.followed:
            curve(upper, t[part.rows], y[part.rows], COLOURS['y'], 'y')
            legend_above(upper)
        label(upper, part.name)
        label(lower, x=TIME)
    if reference.followed:
        label(grid[0][0], y='[unit of y]')
        label(grid[1][0], y='y minus reference [unit of y]')
    else:
        label(grid[0][0], y=f'reference $y_m$ [unit of $y_m$]{late}')
        label(grid[1][0], y='output y [unit of y]')
    return figure


def draw_input(run: RunRecord, parts: Sequence[Part]) -> Figure:
    """Desired and true input of G, and the control v that causes it."""
    figure = new_figure(5.6)
    grid = figure.subplots(2, len(parts), sharex='col', squeeze=False)
    t = run.column('t')
    known = bool(np.isfinite(run.column('u')).any())
    for column, part in enumerate(parts):
        upper, lower = grid[0][column], grid[1][column]
        if known:
            curve(upper, t[part.rows], run.column('u')[part.rows], COLOURS['u'], 'u', width=1.6)
        curve(upper, t[part.rows], run.column('u_d')[part.rows], COLOURS['u_d'], '$u_d$',
              '--' if known else '-', 1.6)
        curve(lower, t[part.rows], run.column('v')[part.rows], COLOURS['v'])
        label(upper, part.name)
        label(lower, x=TIME)
    label(grid[0][0], y='input of G [unit of u]')
    label(grid[1][0], y='control v [unit of v]')
    legend_above(grid[0][-1])
    return figure


def draw_innovation(run: RunRecord, end: Part) -> Figure:
    """y minus its prediction: the health of the model where no truth is known."""
    figure = new_figure(3.4)
    for axes, part in zip(figure.subplots(1, 2), (WHOLE, end), strict=True):
        t = run.column('t')[part.rows]
        curve(axes, t, run.column('innovation')[part.rows], COLOURS['e'])
        shade(axes, t, frozen(run)[part.rows], 'frozen')
        plain_numbers(axes)
        label(axes, part.name, r'$y - \hat{y}$ [unit of y]', TIME)
    return figure
