"""Every figure of `report`, `compare` and `simulate --sweep`, and what others draw theirs with."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from backlash_ros.core.parameters.parameter import Value
from backlash_ros.core.parameters.table import BY_NAME
from backlash_ros.core.simulation.metrics import SETTLING_TOLERANCE
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.runs.figure_data import (
    ErrorCurves,
    FollowedReference,
    LawTrace,
    Part,
    control_error,
    estimated_loop,
    frozen,
)
from backlash_ros.topics import BACKLASH

Array = NDArray[np.float64]

TIME_LABEL = 'time t [s]'  # label of an axis
# Okabe-Ito and Tol: distinct with every kind of colour vision.
HUES = {
    'm': '#0072B2', 'c_r': '#D55E00', 'c_l': '#009E73',
    'u': '#000000', 'u_d': '#E69F00', 'v': '#CC79A7', 'y': '#332288', 'y_m': '#777777',
    'e': '#882255', 'true': '#000000',
}
CYCLE = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#332288', '#777777', '#000000')
DASHES = ('-', '--', '-.', ':')
HATS = {'m': r'\hat{m}', 'c_r': r'\hat{c}_r', 'c_l': r'\hat{c}_l'}
LINE_STYLES = {'m': '-', 'c_r': '--', 'c_l': '-.'}
BACKLASH_UNITS = {'m': 'unit of u/v', 'c_r': 'unit of v', 'c_l': 'unit of v'}
WHOLE_RUN = Part('Whole run', slice(None))

matplotlib.rcParams.update({
    'axes.axisbelow': True, 'axes.grid': True, 'axes.spines.right': False,
    'axes.spines.top': False, 'axes.titlelocation': 'left', 'axes.titlesize': 11,
    'axes.titleweight': 'bold', 'axes.formatter.useoffset': False,
    'axes.formatter.limits': (-5, 6), 'figure.constrained_layout.use': True, 'figure.dpi': 130,
    'grid.color': '#dddddd', 'grid.linewidth': 0.6, 'legend.fontsize': 10,
    'legend.frameon': False, 'lines.linewidth': 1.3,
    'agg.path.chunksize': 20_000,  # of a curve with more points than the eye resolves
})


def new_figure(height: float) -> Figure:
    """Figure of the common width that needs no display."""
    return Figure(figsize=(10.0, height))


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    # savefig would lay it out, and go through all there is to draw, once more.
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def label(axes: Axes, title: str = '', y: str = '', x: str = '') -> None:
    """Set the title and the labels with units that are given."""
    if title:
        axes.set_title(title)
    if x:
        axes.set_xlabel(x)
    if y:
        axes.set_ylabel(y)


def legend_above(axes: Axes) -> None:
    """Put the legend in one row above the axes, at the right, beside the title."""
    axes.legend(
        loc='lower right', bbox_to_anchor=(1.0, 1.0), ncol=9, borderaxespad=0.1,
        handlelength=2.2, columnspacing=1.4,
    )


def legend_below(figure: Figure, axes: Axes, title: str = '') -> None:
    """Put the legend of axes below all axes of the figure."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, title=title or None, loc='outside lower center', ncol=4)


def limit_decades(axes: Axes, lowest: float, highest: float, decades: float = 8.0) -> None:
    """Make y logarithmic over at most so many decades: what is below them is as good as zero."""
    axes.set_yscale('log')
    if 0.0 < highest < np.inf:
        axes.set_ylim(max(lowest, highest * 10.0**-decades) * 0.6, highest * 1.7)


def curve(
    axes: Axes, t: Array, values: Array, colour: str, name: str = '', style: str = '-',
    width: float = 1.3, alpha: float = 1.0,
) -> None:
    """Draw one signal over time."""
    axes.plot(t, values, color=colour, linestyle=style, linewidth=width, alpha=alpha,
              label=name or '_')


def zero_line(axes: Axes) -> None:
    """Draw a thin line at y = 0."""
    axes.axhline(0.0, color='#444444', linewidth=0.8)


def band(axes: Axes, t: Array, low: Array, high: Array, colour: str, name: str = '') -> None:
    """Fill between two signals over time, where both are known."""
    step = slice(None, None, max(len(t) // 2000, 1))  # the eye resolves no more points
    axes.fill_between(
        t[step], low[step], high[step], color=colour, alpha=0.18, linewidth=0, label=name or '_',
    )


def shade(axes: Axes, t: Array, where: NDArray[np.bool_], name: str) -> None:
    """Shade the times for which `where` holds."""
    if where.any():
        axes.fill_between(
            t, 0, 1, where=where.tolist(), transform=axes.get_xaxis_transform(), step='post',
            color='#bbbbbb', alpha=0.4, linewidth=0, label=name,
        )


def limits(values: Sequence[Array], margin: float) -> tuple[float, float]:
    """Lower and upper limit of all finite values with a margin around them."""
    finite = np.concatenate([part[np.isfinite(part)] for part in values])
    if finite.size == 0:
        return -1.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    room = margin * (high - low) or margin * max(abs(high), 1.0)
    return low - room, high + room


def time_grid(figure: Figure, rows: int, parts: Sequence[Part], **others: Any) -> NDArray[Any]:
    """Axes, shape (rows, len(parts)): each column shows one part of the run."""
    grid = figure.subplots(rows, len(parts), sharex='col', squeeze=False, **others)
    for column, part in enumerate(parts):
        label(grid[0, column], part.name)
        label(grid[-1, column], x=TIME_LABEL)
    return np.asarray(grid)


def draw_parameter_errors(
    run: RunRecord, start: Part, settling: Mapping[str, float | None],
) -> Figure:
    """Errors of the estimates over time, as Figure 4 of the paper, and their relative size."""
    figure = new_figure(7.4)
    parts = (start, WHOLE_RUN)
    grid = time_grid(figure, 2, parts, sharey='row')
    for column, part in enumerate(parts):
        t = run.column('t')[part.rows]
        absolute, relative = grid[:, column]
        errors, percents = [], []
        for name in BACKLASH:
            truth, std = run.column(f'true_{name}'), run.column(f'std_{name}')[part.rows]
            errors.append(truth - run.column(name))
            unit = BACKLASH_UNITS[name].removeprefix('unit of ')
            error = errors[-1][part.rows]
            curve(absolute, t, error, HUES[name], f'${name} - {HATS[name]}$ [{unit}]',
                  LINE_STYLES[name], 1.8)
            band(absolute, t, error - 2 * std, error + 2 * std, HUES[name])
            # Nothing is a percentage of zero, and the logarithm has no zero.
            size = np.abs(errors[-1] / np.where(truth == 0.0, np.nan, truth))
            percents.append(np.maximum(100.0 * size, 1e-300))
            curve(relative, t, percents[-1][part.rows], HUES[name], '', LINE_STYLES[name], 1.5)
            settled = settling[name]
            if settled is not None and settled <= t[-1]:
                relative.plot(settled, 100.0 * SETTLING_TOLERANCE, 'o', color=HUES[name],
                              markersize=7, markeredgecolor='white', zorder=5)
        shade(absolute, t, frozen(run)[part.rows], 'frozen')
        zero_line(absolute)
        absolute.set_ylim(*limits(errors, margin=0.08))
        _tolerance_line(relative)
        known = np.concatenate([values[np.isfinite(values)] for values in percents])
        if known.size:
            limit_decades(relative, min(float(known.min()), 0.5), max(float(known.max()), 2.0))
    label(grid[0, 0], y='true minus estimated')
    label(grid[1, 0], y='size of the error [% of the true value]')
    legend_below(figure, grid[0, 1])
    return figure


def _tolerance_line(axes: Axes) -> None:
    axes.axhline(100.0 * SETTLING_TOLERANCE, color='#444444', linewidth=0.9, linestyle=':')


def draw_estimates(run: RunRecord) -> Figure:
    """Estimates over time with two standard deviations, and the truth where it is known."""
    figure = new_figure(7.0)
    t = run.column('t')
    for axes, name in zip(time_grid(figure, 3, [WHOLE_RUN])[:, 0], BACKLASH, strict=True):
        estimate, std = run.column(name), run.column(f'std_{name}')
        title = f'${HATS[name]}$ = {estimate[-1]:.6g}'
        if run.has_truth:
            curve(axes, t, run.column(f'true_{name}'), HUES['true'], 'true', width=6.0,
                  alpha=0.22)
        curve(axes, t, estimate, HUES[name], 'estimated', width=1.8)
        if np.isfinite(std).any():
            band(axes, t, estimate - 2 * std, estimate + 2 * std, HUES[name],
                 '±2 standard deviations')
            # The first, nearly boundless uncertainty would flatten everything else: the limits
            # are those of the curves, with a margin for the deviations.
            axes.set_ylim(*limits([estimate, run.column(f'true_{name}')], 0.25))
            title += f' ± {2 * std[-1]:.2g}'
        shade(axes, t, frozen(run), 'frozen')
        label(axes, f'{title} at the end', f'${HATS[name]}$ [{BACKLASH_UNITS[name]}]')
        legend_above(axes)
    return figure


def draw_control_error(run: RunRecord, parts: Sequence[Part]) -> Figure:
    """Control error e = u - u_d (3.4) over the whole run, and closer at its start and end."""
    return _draw_closer(run, control_error(run), '$u - u_d$ [unit of u]', parts)


def draw_innovation(run: RunRecord, parts: Sequence[Part]) -> Figure:
    """y minus its prediction: the health of the model where no truth is known."""
    return _draw_closer(run, run.column('innovation'), r'$y - \hat{y}$ [unit of y]', parts)


def _draw_closer(run: RunRecord, values: Array, name: str, parts: Sequence[Part]) -> Figure:
    """One signal over the whole run, and below it over each part."""
    figure = new_figure(5.6)
    grid = figure.add_gridspec(2, len(parts))
    panels = [(figure.add_subplot(grid[0, :]), WHOLE_RUN)]
    panels += [(figure.add_subplot(grid[1, i]), part) for i, part in enumerate(parts)]
    for axes, part in panels:
        t = run.column('t')[part.rows]
        curve(axes, t, values[part.rows], HUES['e'])
        shade(axes, t, frozen(run)[part.rows], 'frozen')
        zero_line(axes)
        label(axes, part.name, name, '' if part is WHOLE_RUN else TIME_LABEL)
    return figure


def draw_laws(traces: Sequence[LawTrace], start: Part) -> Figure:
    """Control errors of the laws, as Figure 5 of the paper: each alone, then their size."""
    figure = new_figure(1.7 * len(traces) + 3.4)
    parts = (start, WHOLE_RUN)
    grid = time_grid(figure, len(traces) + 1, parts, height_ratios=[1.0] * len(traces) + [1.7])
    for column, part in enumerate(parts):
        for axes, trace in zip(grid[:-1, column], traces, strict=True):
            curve(axes, trace.t[part.rows], trace.e[part.rows], _law_colour(trace))
            zero_line(axes)
            axes.text(0.5, 0.5, fill(trace.note, 50), transform=axes.transAxes, ha='center',
                      va='center', fontsize=9)
        for trace, style in zip(traces, DASHES * len(traces), strict=False):
            size = np.where(trace.rms > 0.0, trace.rms, np.nan)[part.rows]
            curve(grid[-1, column], trace.t[part.rows], size, _law_colour(trace), trace.law,
                  style, 1.8)
        sizes = [trace.rms[np.isfinite(trace.rms) & (trace.rms > 0.0)] for trace in traces]
        # A law that diverges leaves the axes, which are made for those that do not.
        highest = [float(size.max()) for size in sizes if size.size]
        if highest:
            # Not the least of all: an error begins at zero.
            low = float(np.percentile(np.concatenate(sizes), 2))
            limit_decades(grid[-1, column], low, min(max(highest), 1e3 * min(highest)))
    for axes, trace in zip(grid[:-1, 0], traces, strict=True):
        origin = 'this run' if trace.recorded else 'simulated'
        label(axes, y=f'{trace.law}\n({origin})\n$u - u_d$ [unit of u]')
    figure.align_ylabels(grid[:, 0])
    label(grid[-1, 0], y='RMS of $u - u_d$\nover one period\n[unit of u]')
    legend_above(grid[-1, 1])
    return figure


def _law_colour(trace: LawTrace) -> str:
    colours = {'moving_horizon': '#44AA99', 'lms': '#AA4499', 'printed': '#999933'}
    return colours.get(trace.law, '#555555')


def draw_hysteresis(run: RunRecord, end: Part) -> Figure:
    """v-u loop at the end of the run with the true and the estimated lines."""
    figure = new_figure(6.0)
    axes = figure.subplots()
    v, truth = run.column('v'), run.has_truth
    u = run.column('u') if truth else estimated_loop(run)
    span = np.array(limits([v[end.rows]], margin=0.15))
    for name, side in (('c_r', 'right'), ('c_l', 'left')):
        m, c = run.column('m')[-1], run.column(name)[-1]
        if truth:
            true_m, true_c = run.column('true_m')[-1], run.column(f'true_{name}')[-1]
            curve(axes, span, true_m * (span - true_c), HUES[name],
                  f'true {side} line\n$m(v - {name})$', width=6.0, alpha=0.35)
        curve(axes, span, m * (span - c), HUES[name],
              f'estimated {side} line\n${HATS["m"]}(v - {HATS[name]})$', '--', 1.6)
    axes.plot(v, u, color='#999999', linewidth=0.8, zorder=1, label='earlier')
    t = run.column('t')[end.rows]
    axes.plot(v[end.rows], u[end.rows], color=HUES['u'], linewidth=1.1, marker='.',
              markersize=3, label=f'samples from\n{t[0]:.4g} s to {t[-1]:.4g} s')
    axes.set_xlim(*span)
    axes.set_ylim(*limits([u[end.rows]], margin=0.25))
    label(axes, 'u = B[v]' if truth else 'u = B[v] as the last estimates see it',
          'u [unit of u]', 'control v [unit of v]')
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0), labelspacing=1.0)
    return figure


def draw_output(run: RunRecord, end: Part, reference: FollowedReference) -> Figure:
    """Reference and output: on one scale where y follows, else each on its own."""
    figure = new_figure(5.6)
    t, y = run.column('t'), run.column('y')
    parts = (WHOLE_RUN, end)
    grid = time_grid(figure, 2, parts)
    late = f', {reference.delay:.4g} s late' if reference.delay else ''
    below = y - reference.values if reference.followed else y
    for (upper, lower), part in zip(grid.T, parts, strict=True):
        curve(upper, t[part.rows], reference.values[part.rows], HUES['y_m'], f'$y_m${late}',
              '--' if reference.followed else '-')
        curve(lower, t[part.rows], below[part.rows], HUES['y'])
        if reference.followed:
            curve(upper, t[part.rows], y[part.rows], HUES['y'], 'y')
            legend_above(upper)
    above = '[unit of y]' if reference.followed else f'reference $y_m$ [unit of $y_m$]{late}'
    label(grid[0, 0], y=above)
    label(grid[1, 0], y='y minus reference [unit of y]' if reference.followed else
          'output y [unit of y]')
    return figure


def draw_input(run: RunRecord, parts: Sequence[Part]) -> Figure:
    """Desired and true input of G, and the control v that causes it."""
    figure = new_figure(5.6)
    grid = time_grid(figure, 2, parts)
    t = run.column('t')
    known = bool(np.isfinite(run.column('u')).any())
    for (upper, lower), part in zip(grid.T, parts, strict=True):
        if known:
            curve(upper, t[part.rows], run.column('u')[part.rows], HUES['u'], 'u', width=1.6)
        curve(upper, t[part.rows], run.column('u_d')[part.rows], HUES['u_d'], '$u_d$',
              '--' if known else '-', 1.6)
        curve(lower, t[part.rows], run.column('v')[part.rows], HUES['v'])
    label(grid[0, 0], y='input of G [unit of u]')
    label(grid[1, 0], y='control v [unit of v]')
    legend_above(grid[0, -1])
    return figure


def draw_sweep(
    swept: str, values: Sequence[Value], lines: Mapping[str, Array], others: str = '',
) -> Figure:
    """Relative RMSE of m, c_r, c_l [%] and the settling time of the slowest of them [s].

    swept: the parameter on the horizontal axis, and the values it takes. lines: by the values of
    the other parameters, shape (4, len(values)). others: the names of these.
    """
    figure = new_figure(7.4)
    panels = figure.subplots(2, 2).ravel().tolist()
    numbers = [float(value) for value in values
               if isinstance(value, (int, float)) and not isinstance(value, bool)]
    places = numbers if len(numbers) == len(values) else list(map(float, range(len(values))))
    for i, (name, rows) in enumerate(lines.items()):
        for panel, row in zip(panels, rows, strict=True):
            panel.plot(places, row, color=CYCLE[i % len(CYCLE)], marker='osD^vP*X'[i % 8],
                       linewidth=1.6, markersize=6, label=name)
    unit = f' [{BY_NAME[swept].unit}]' if BY_NAME[swept].unit else ''
    for panel, parameter in zip(panels, (*BACKLASH, None), strict=True):
        label(panel, x=f'{swept}{unit}')
        if places is not numbers:
            panel.set_xticks(places, list(map(str, values)))
        elif min(places) > 0.0 and max(places) / min(places) >= 20.0:
            panel.set_xscale('log')
        if parameter is None:
            label(panel, 'Settled within 1 % (median; no point: never)', 'time [s]')
            low, high = panel.get_ylim()
            panel.set_ylim(0.0, high + 0.1 * (high - low))
            panel.set_xlim(panels[0].get_xlim())
        else:
            panel.set_yscale('log')
            _tolerance_line(panel)
            label(panel, f'RMSE of ${parameter}$ at the end', '% of the true value')
    if others:
        legend_below(figure, panels[0], others)
    return figure


def draw_comparison(loops: Sequence[ErrorCurves], window_s: float) -> Figure:
    """Size of the control error (Figure 5 of the paper, extended) and of the tracking error.

    window_s: over which the RMS was taken [s].
    """
    figure = new_figure(8.4)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for i, loop in enumerate(loops):
        look = CYCLE[i % len(CYCLE)], loop.name, DASHES[i % len(DASHES)], loop.width
        curve(upper, loop.t, loop.control, *look)
        if loop.tracking is not None:
            curve(lower, loop.t, loop.tracking, *look)
    for axes, shown in (
        (upper, [loop.control for loop in loops]),
        (lower, [loop.tracking for loop in loops if loop.tracking is not None]),
    ):
        known = np.concatenate([values[values > 0.0] for values in shown] or [np.empty(0)])
        if known.size:
            low, high = np.percentile(known, [2, 100])
            limit_decades(axes, float(low), float(high))
    label(upper, 'Control error', f'RMS of $u - u_d$ over {window_s:g} s\n[unit of u]')
    label(lower, 'Tracking error, where y is meant to follow',
          f'RMS of $y - y_m$ over {window_s:g} s\n[unit of y]', TIME_LABEL)
    handles, names = upper.get_legend_handles_labels()
    figure.legend(handles, names, loc='outside lower center', ncol=3)
    return figure


def draw_log(run: RunRecord) -> Figure:
    """v and y of a log over time, and over each other."""
    figure = new_figure(6.0)
    rooms = figure.subplot_mosaic('ac;bc', width_ratios=(2.0, 1.0))
    t, v, y = (run.column(name) for name in ('t', 'v', 'y'))
    for axes, (x, values, name) in zip(
        rooms.values(), ((t, v, 'v'), (v, y, 'y'), (t, y, 'y')), strict=True,
    ):
        curve(axes, x, values, HUES[name], width=0.9)
        label(axes, y=name, x='v' if x is v else TIME_LABEL)
    return figure
