"""All figures of `report`, `compare` and `identify`, and helpers that other figures use as well."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from backlash_ros.core.estimate import Status
from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.judgement.deviations import autocorrelation
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.simulation import run_record
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli import number
from backlash_ros.tools.runs.summary import ERROR_WINDOW_S, moving_rms
from backlash_ros.topics import BACKLASH

Line = tuple[Any, ...]  # arguments of `curve` after the axes: t, values, colour and more

TIME_LABEL = 'time t [s]'  # label of an axis
# Palettes of Okabe-Ito and Tol: distinct with every kind of colour vision.
HUES = {
    'm': '#0072B2', 'c_r': '#D55E00', 'c_l': '#009E73', 'v': '#CC79A7', 'u_d': '#E69F00',
    'y': '#332288', 'y_m': '#777777', 'u': '#000000', 'e': '#882255', 'true': '#000000',
}
HATS = {'m': r'\hat{m}', 'c_r': r'\hat{c}_r', 'c_l': r'\hat{c}_l'}
LINE_STYLES = {'m': '-', 'c_r': '--', 'c_l': '-.'}
BACKLASH_UNITS = {'m': 'unit of u/v', 'c_r': 'unit of v', 'c_l': 'unit of v'}
WHOLE_RUN = {'Whole run': slice(None)}

matplotlib.style.use(Path(__file__).with_suffix('.mplstyle'))


def new_figure(height: float, laid_out: bool = True) -> Figure:
    """Figure of the common width, without a display. laid_out: False for fixed margins."""
    figure = Figure(figsize=(10.0, height), constrained_layout=laid_out)
    if not laid_out:  # laying out takes as long as drawing
        figure.subplots_adjust(left=0.1, right=0.985, bottom=0.55 / height,
                               top=1.0 - 0.4 / height, wspace=0.2, hspace=0.4)
    return figure


def png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    # savefig would lay it out and draw it once more.
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def label(axes: Axes, title: str = '', y: str = '', x: str = '') -> None:
    """Set the title and the labels of the axes, if given."""
    texts = {'title': title, 'ylabel': y, 'xlabel': x}
    axes.set(**{key: text for key, text in texts.items() if text})


def legend_above(axes: Axes) -> None:
    axes.legend(loc='lower right', bbox_to_anchor=(1.0, 1.0), ncol=9, borderaxespad=0.1)


def legend_below(figure: Figure, axes: Axes) -> None:
    figure.legend(*axes.get_legend_handles_labels(), loc='outside lower center', ncol=3)


def curve(
    axes: Axes, t: Array, values: Array, colour: str, name: str = '', style: str = '-',
    width: float = 1.3, alpha: float = 1.0,
) -> None:
    axes.plot(t, values, color=colour, linestyle=style, linewidth=width, alpha=alpha,
              label=name or '_')


def zero_line(axes: Axes) -> None:
    axes.axhline(0.0, color='#444444', linewidth=0.8)


def band(axes: Axes, t: Array, low: Array, high: Array, colour: str, name: str = '') -> None:
    """Fill between two signals over time, where both are known."""
    step = slice(None, None, max(len(t) // 2000, 1))  # the eye resolves no more points
    axes.fill_between(t[step], low[step], high[step], color=colour, alpha=0.18, linewidth=0,
                      label=name or '_')


def shade(axes: Axes, t: Array, where: NDArray[np.bool_], name: str) -> None:
    if where.any():  # otherwise the legend would have an entry all the same
        axes.fill_between(t, 0, 1, where=where.tolist(), transform=axes.get_xaxis_transform(),
                          step='post', color='#bbbbbb', alpha=0.4, linewidth=0, label=name)


def limits(values: Sequence[Array], margin: float) -> tuple[float, float]:
    """Lower and upper limit of all finite values with a margin around them."""
    finite = np.concatenate([part[np.isfinite(part)] for part in values])
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 1.0)
    room = margin * (high - low) or margin * max(abs(high), 1.0)
    return low - room, high + room


def draw_panels(
    height: float, rows: Mapping[str, Sequence[Line]], parts: Mapping[str, slice] = WHOLE_RUN,
    frozen_in: RunRecord | None = None, laid_out: bool = True, **others: Any,
) -> tuple[Figure, NDArray[Any]]:
    """A figure whose columns show parts of a run, and its axes, shape (rows, parts).

    rows: lines by label of the vertical axis. parts: samples of the run by title. frozen_in: run
    whose times without learning are shaded.
    """
    figure = new_figure(height, laid_out)
    grid = np.asarray(figure.subplots(len(rows), len(parts), sharex='col', squeeze=False, **others))
    for axes, name in zip(grid[:, 0], rows, strict=True):
        label(axes, y=name)
    for column, (title, part) in zip(grid.T, parts.items(), strict=True):
        label(column[0], title)
        label(column[-1], x=TIME_LABEL)
        for axes, lines in zip(column, rows.values(), strict=True):
            for t, values, *look in lines:
                if np.isfinite(values).any():
                    curve(axes, t[part], values[part], *look)
            if frozen_in is not None:
                frozen = frozen_in.column('status')[part] >= float(Status.NOT_EXCITED)
                shade(axes, frozen_in.column('t')[part], frozen, 'frozen')
    return figure, grid


def draw_parameter_errors(
    run: RunRecord, start: slice, settling: Mapping[str, float | None],
) -> Figure:
    """Errors of the estimates over time, as Figure 4 of the paper, and their relative size."""
    t, tolerance = run.column('t'), 100.0 * run_record.SETTLING_TOLERANCE
    errors: list[Line] = []
    percents: list[Line] = []
    for name in BACKLASH:
        truth, hue, style = run.column(f'true_{name}'), HUES[name], LINE_STYLES[name]
        error, unit = truth - run.column(name), BACKLASH_UNITS[name].removeprefix('unit of ')
        errors.append((t, error, hue, f'${name} - {HATS[name]}$ [{unit}]', style, 1.8))
        # A truth of 0 has no percentages, and a logarithmic axis no 0.
        size = np.maximum(100.0 * np.abs(error / np.where(truth == 0.0, np.nan, truth)), 1e-6)
        percents.append((t, size, hue, '', style, 1.5))
    figure, grid = draw_panels(7.4, {
        'true minus estimated': errors, 'size of the error [% of the true value]': percents,
    }, {'Start': start, **WHOLE_RUN}, run, sharey='row')
    for absolute, relative in grid.T:
        for name in BACKLASH:
            if settling[name] is not None:
                relative.plot(settling[name], tolerance, 'o', color=HUES[name])
        zero_line(absolute)
        absolute.set_ylim(*limits([error for _, error, *_ in errors], margin=0.08))
        relative.axhline(tolerance, color='#444444', linewidth=0.9, linestyle=':')
        relative.set_yscale('log')
    grid[0, 0].set_xlim(*limits([t[start]], margin=0.05))
    legend_below(figure, grid[0, 1])
    return figure


def draw_estimates(run: RunRecord, recorded: RunRecord | None = None) -> Figure:
    """Estimates over time with two standard deviations, and the truth if it is known.

    recorded: the run that was replayed; its estimates, innovation and status replace the truth.
    """
    t, names = run.column('t'), {f'${HATS[n]}$ [{BACKLASH_UNITS[n]}]': n for n in BACKLASH}
    beside, prefix, wide, own = run, 'true_', 'true', 'estimated'
    if recorded is not None:
        names |= {'innovation [y]': 'innovation', 'status': 'status'}
        beside, prefix, wide, own = recorded, '', 'run', 'replay'
    figure, grid = draw_panels(1.0 + 2.0 * len(names), {text: [
        (t, beside.column(f'{prefix}{name}'), HUES['true'], wide, '-', 6.0, 0.22),
        (t, run.column(name), HUES.get(name, HUES['e']), own, '-', 1.8),
    ] for text, name in names.items()}, frozen_in=run)
    for axes, name in zip(grid[:, 0], BACKLASH, strict=False):
        estimate, std = run.column(name), 2 * run.column(f'std_{name}')
        band(axes, t, estimate - std, estimate + std, HUES[name], '±2 standard deviations')
        # The huge initial uncertainty would flatten everything else: the limits are those of the
        # curves, with a margin for the standard deviations.
        axes.set_ylim(*limits([estimate, beside.column(f'{prefix}{name}')], 0.25))
        label(axes, f'${HATS[name]}$ = {estimate[-1]:.6g} ± {number(std[-1], 2)} at the end')
        legend_above(axes)
    if recorded is not None:
        grid[-1, 0].set_yticks([int(state) for state in Status], [state.word for state in Status])
    return figure


def draw_closer(run: RunRecord, values: Array, name: str, parts: Mapping[str, slice]) -> Figure:
    """A signal over the whole run and, beside it, over each part."""
    lines = [(run.column('t'), values, HUES['e'])]
    return draw_panels(3.6, {name: lines}, {**WHOLE_RUN, **parts}, run)[0]


def draw_hysteresis(run: RunRecord, end: slice) -> Figure:
    """The v-u loop at the end of a run, with the true and the estimated lines."""
    figure = new_figure(6.0)
    axes = figure.subplots()
    v, truth = run.column('v'), run.has_truth
    m, c_r, c_l = (float(run.column(name)[-1]) for name in BACKLASH)
    u = run.column('u') if truth else m * (play(v, max(c_r - c_l, 0.0), c_r) - c_r)
    span = np.array(limits([v[end]], margin=0.15))
    for name, side, c in (('c_r', 'right', c_r), ('c_l', 'left', c_l)):
        if truth:
            true_m, true_c = run.column('true_m')[-1], run.column(f'true_{name}')[-1]
            curve(axes, span, true_m * (span - true_c), HUES[name],
                  f'true {side} line\n$m(v - {name})$', width=6.0, alpha=0.35)
        curve(axes, span, m * (span - c), HUES[name],
              f'estimated {side} line\n${HATS["m"]}(v - {HATS[name]})$', '--', 1.6)
    curve(axes, v, u, '#999999', 'earlier', width=0.8)
    curve(axes, v[end], u[end], HUES['u'], 'at the end')
    axes.set(xlim=span, ylim=limits([u[end]], margin=0.25))
    label(axes, 'u = B[v]' if truth else 'u = B[v] as the last estimates see it',
          'u [unit of u]', 'control v [unit of v]')
    axes.legend(loc='upper left', bbox_to_anchor=(1.01, 1.0))
    return figure


def draw_output(run: RunRecord, end: slice, delay: int, followed: bool) -> Figure:
    """Reference, delayed by `delay` samples, and output: on one scale if y follows, else on two."""
    t, y, y_m = run.column('t'), run.column('y'), run_record.delayed_reference(run, delay)
    late = f', {delay * run.sample_period:.4g} s late' if delay else ''
    reference, output = (t, y_m, HUES['y_m']), (t, y, HUES['y'])
    figure, grid = draw_panels(5.6, {
        '[unit of y]': [(*reference, f'$y_m${late}', '--'), (*output, 'y')],
        'y minus reference [unit of y]': [(t, y - y_m, HUES['y'])],
    } if followed else {
        f'reference $y_m$ [unit of $y_m$]{late}': [reference], 'output y [unit of y]': [output],
    }, {**WHOLE_RUN, 'End': end})
    if followed:
        legend_above(grid[0, 1])
    return figure


def draw_input(run: RunRecord, parts: Mapping[str, slice]) -> Figure:
    t = run.column('t')
    figure, grid = draw_panels(5.6, {
        'input of G [unit of u]': [(t, run.column('u'), HUES['u'], 'u', '-', 1.6),
                                   (t, run.column('u_d'), HUES['u_d'], '$u_d$', '--', 1.6)],
        'control v [unit of v]': [(t, run.column('v'), HUES['v'])],
    }, parts)
    legend_above(grid[0, -1])
    return figure


def draw_error_curves(runs: Mapping[str, RunRecord], delays: Mapping[str, int] = {}) -> Figure:
    """Moving RMS of the control errors (Figure 5 of the paper) and of tracking errors.

    delays: samples by which y is to lag y_m, for those runs in which it is to follow.
    """
    colours = [HUES[name] for name in ('m', 'c_r', 'c_l', 'v', 'u_d', 'y', 'y_m', 'u')]
    rows: dict[str, list[Line]] = {}
    for i, (name, run) in enumerate(runs.items()):
        # Wide, as the curve of the loop without backlash will cover it.
        width = 3.4 if name == 'moving_horizon, tracking' else 1.7
        look = colours[i % 8], name, ('-', '--', '-.', ':')[i % 4], width
        errors = {'u - u_d': run_record.control_error(run)}
        if name in delays:
            errors['y - y_m'] = run.column('y') - run_record.delayed_reference(run, delays[name])
        for what, error in errors.items():
            rows.setdefault(f'RMS of ${what}$ over {ERROR_WINDOW_S} s\n[unit of {what[0]}]', []) \
                .append((run.column('t'), moving_rms(error, run.sample_period), *look))
    figure, grid = draw_panels(4.2 * len(rows), rows)
    titles = 'Control error', 'Tracking error, where y is meant to follow'
    for axes, lines, title in zip(grid[:, 0], rows.values(), titles, strict=False):
        label(axes, title)
        known = [size[np.isfinite(size) & (size > 0.0)] for _, size, *_ in lines]
        if highest := [float(size.max()) for size in known if size.size]:
            axes.set_yscale('log')
            # Leave out errors near 0 at the start, and curves of laws that diverge.
            low, high = np.percentile(np.concatenate(known), 2), 1e3 * np.median(highest)
            axes.set_ylim(0.6 * float(low), 1.7 * min(max(highest), float(high)))
    legend_below(figure, grid[0, 0])
    return figure


def draw_log(run: RunRecord) -> Figure:
    figure = new_figure(6.0)
    rooms = figure.subplot_mosaic('ac;bc', width_ratios=(2.0, 1.0))
    for room, x, y in (('a', 't', 'v'), ('b', 't', 'y'), ('c', 'v', 'y')):
        curve(rooms[room], run.column(x), run.column(y), HUES[y], width=0.9)
        label(rooms[room], y=y, x='v' if x == 'v' else TIME_LABEL)
    return figure


def draw_held_out(found: Identification, details: Details) -> Figure:
    """Measured and simulated y on the held-out samples, and the difference."""
    first, y, simulated, rms, _ = details.held_out
    t = _times(found, first, simulated)
    figure, grid = draw_panels(6.2, {
        'y': [(t, y, HUES['y'], 'measured', '-', 2.2),
              (t, simulated, HUES['u_d'], 'simulated', '--')],
        'difference': [(t, y - simulated, HUES['e'])],
    }, laid_out=False, height_ratios=[2.2, 1.0])
    upper, lower = grid[:, 0]
    label(upper, f'{1.0 - rms / max(float(np.nanstd(y)), 1e-300):.2%} of the motion is predicted')
    legend_above(upper)
    zero_line(lower)
    return figure


def _times(found: Identification, first: int, values: Array) -> Array:
    return found.sample_period * np.arange(first, first + len(values), dtype=float)


def draw_loop(found: Identification, details: Details) -> Figure:
    """y over v as measured, and what the identified backlash subtracts from v."""
    newest, figure = slice(-4000, None), new_figure(4.6, laid_out=False)
    left, right = figure.subplots(1, 2)
    v, o = details.v[newest], details.observed
    curve(left, v, o.y[newest], HUES['y'], width=0.8)
    label(left, 'As measured', 'y', 'v')
    curve(right, v, v - o.p[newest] + found.c_r, HUES['u'], width=0.8)
    for name, value in (('c_r', found.c_r), ('c_l', found.c_l)):
        right.axhline(value, color=HUES[name], linewidth=4.0, alpha=0.5,
                      label=f'${name}$ = {value:.4g}')
    label(right, 'As found', 'v − u / m', 'v')
    legend_above(right)
    return figure


def draw_residual(found: Identification, details: Details) -> Figure:
    """Residual of the whole record: over time, its autocorrelation, and over v."""
    figure, residual = new_figure(6.6, laid_out=False), details.observed.residual
    over_time, correlated, over_v = figure.subplot_mosaic('tt;cv').values()
    curve(over_time, _times(found, details.first, residual), residual, HUES['e'], width=0.8)
    label(over_time, f'Deviation {found.model.noise_std:.3g}', 'residual', TIME_LABEL)
    bound = 2.0 / np.sqrt(np.isfinite(residual).sum())
    r = autocorrelation(residual, 60)[1:]
    correlated.axhspan(-bound, bound, color='#bbbbbb', alpha=0.5, linewidth=0)
    correlated.vlines(np.arange(1, len(r) + 1), 0.0, r, color=HUES['e'], linewidth=1.5)
    correlated.set_ylim(*limits([np.append(r, [-3.0 * bound, 3.0 * bound])], 0.1))
    label(correlated, 'Autocorrelation', x='lag [samples]')
    over_v.plot(details.v, residual, '.', color=HUES['e'], markersize=2, alpha=0.4,
                rasterized=True)
    label(over_v, 'Over v', x='v')
    for axes in (over_time, correlated, over_v):
        zero_line(axes)
    return figure


def draw_bode(found: Identification, details: Details) -> Figure:
    """Frequency response of m G with two standard deviations; y moved between the dotted lines."""
    w = np.geomspace(max(found.model.frequencies[0] / 5.0, 1e-5), 0.98 * np.pi, 400)
    f = w / (2.0 * np.pi * found.sample_period)
    value = details.response.at(w) * np.exp(-1j * w * found.model.delay)
    spread = 2.0 * details.response.std(w)
    size, angle = np.abs(value), np.degrees(np.unwrap(np.angle(value)))
    turn = np.degrees(np.arcsin(np.minimum(spread, 1.0)))
    figure, grid = draw_panels(5.6, {
        '|m G| [y/v]': [(f, size, HUES['m'])], 'degrees': [(f, angle, HUES['m'])],
    }, laid_out=False)
    magnitude, phase = grid[:, 0]
    band(magnitude, f, size * np.maximum(1.0 - spread, 1e-3), size * (1.0 + spread), HUES['m'])
    band(phase, f, angle - turn, angle + turn, HUES['m'])
    for edge in found.hertz[[0, -1]]:
        for axes in (magnitude, phase):
            axes.axvline(edge, color='#444444', linestyle=':', linewidth=1.0)
    label(magnitude, 'Magnitude')
    label(phase, 'Phase', x='frequency [Hz]')
    magnitude.set(xscale='log', yscale='log', ylim=(size.min() / 3.0, size.max() * 3.0))
    return figure
