"""The pictures of identify.html: a person judges by them whether the result is to be trusted."""

from __future__ import annotations

import io
from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.identification.order_selection import gives_way
from backlash_ros.core.identification.uncertainty import autocorrelation
from backlash_ros.tools.figures import (
    HUES,
    TIME_LABEL,
    curve,
    label,
    legend_above,
    limits,
    zero_line,
)
from backlash_ros.tools.identify.model_pictures import SURE, draw_bode, draw_poles, new_figure
from backlash_ros.tools.page import Picture

Array = NDArray[np.float64]

LAGS = 60  # of the autocorrelation
MEASURED, SIMULATED, RESIDUAL = HUES['y'], HUES['u_d'], HUES['e']
ORDER_COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9', '#332288')
LOOP_POINTS = 4000  # samples that the curves over v show


def draw(found: Identification) -> Iterator[Picture]:
    """Every picture, in the order of the page; none where nothing was fitted."""
    details = found.details
    if details is None:
        return
    yield Picture(
        'held_out.png', 'Measured and simulated y on samples that were held out',
        'Simulated from v alone, with a model that was fitted to the samples before: the lines '
        'should lie on each other, and the difference should look like noise.',
        _png(draw_held_out(found, details)),
    )
    yield Picture(
        'residual.png', 'Residual of the fit',
        'y minus the simulation of the whole record. Its autocorrelation should stay within the '
        'band of white noise; the rounding of an encoder may leave it. Over v it should show no '
        'shape: a slope or a hook is a nonlinearity that is not in the model.',
        _png(draw_residual(found, details)),
    )
    yield Picture(
        'gap.png', 'Misfit over the gap',
        'What is left over for each width of the gap, everything else refitted. One narrow '
        'valley: the gap is known. Two valleys of one depth: it is not.',
        _png(draw_profile(found, details)),
    )
    yield Picture(
        'orders.png', 'Orders and delays compared',
        'Error on the samples held out. The ring marks the one that was taken. White: a zero '
        'cancels a pole, and the lower order without it is taken instead.',
        _png(draw_orders(details)),
    )
    yield Picture(
        'poles_zeros.png', 'Poles and zeros of G',
        'Ellipses reach two standard deviations. A zero on a pole: a lower order does as well.',
        _png(draw_poles(found, details)),
    )
    yield Picture(
        'bode.png', 'Frequency response of m G',
        'With a band of two standard deviations. Between the dotted lines y moved; outside of '
        'them the record says little.', _png(draw_bode(found, details)),
    )
    yield Picture(
        'loop.png', 'The loop of v and y',
        'Left: v against y as measured. Right: v against the u that was found, between its two '
        'lines.', _png(draw_loop(found, details)),
    )


def _png(figure: Figure) -> bytes:
    """The figure as a PNG file, quickly rather than small."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, pil_kwargs={'compress_level': 1})
    return buffer.getvalue()


def draw_held_out(found: Identification, details: Details) -> Figure:
    """Measured and simulated y over the samples held out, and their difference."""
    figure = new_figure(6.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    first = details.held_out.first
    samples = details.searched
    begin = details.searched_from + first
    t: Array = found.sample_period * np.arange(
        begin, begin + len(details.held_out.simulated), dtype=float
    )
    y = samples.whole_y[first:first + len(t)]
    curve(upper, t, y, MEASURED, 'measured', width=2.2)
    curve(upper, t, details.held_out.simulated, SIMULATED, 'simulated', '--')
    legend_above(upper)
    curve(lower, t, y - details.held_out.simulated, RESIDUAL)
    zero_line(lower)
    share = 1.0 - details.held_out.rms / max(float(np.nanstd(y)), 1e-300)
    label(upper, f'{share:.2%} of the motion is predicted', 'y')
    label(lower, '', 'difference', TIME_LABEL)
    return figure


def draw_residual(found: Identification, details: Details) -> Figure:
    """Residual over time, its autocorrelation, and the residual over v."""
    figure = new_figure(6.6)
    grid = figure.add_gridspec(2, 2)
    over_time = figure.add_subplot(grid[0, :])
    correlated, over_v = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    samples = details.samples
    residual = samples.y - details.fit.simulated
    t: Array = found.sample_period * np.arange(samples.first, samples.last, dtype=float)
    curve(over_time, t, residual, RESIDUAL, width=0.8)
    zero_line(over_time)
    label(over_time, f'Deviation {found.noise_std:.3g}', 'residual', TIME_LABEL)
    known = int(np.isfinite(residual).sum())
    r = autocorrelation(residual, LAGS)[1:]
    bound = SURE / np.sqrt(known)
    correlated.axhspan(-bound, bound, color='#bbbbbb', alpha=0.5, linewidth=0)
    correlated.vlines(np.arange(1, LAGS + 1), 0.0, r, color=RESIDUAL, linewidth=1.5)
    zero_line(correlated)
    correlated.set_ylim(*limits([np.append(r, [-3.0 * bound, 3.0 * bound])], 0.1))
    label(correlated, f'Autocorrelation (Ljung–Box p = {found.ljung_box:.2g})', '', 'lag [samples]')
    v = samples.delayed(samples.v, details.fit.structure.delay)
    over_v.plot(v, residual, '.', color=RESIDUAL, markersize=2, alpha=0.4, rasterized=True)
    centres, means = _means_over(v, residual)
    over_v.plot(centres, means, color='#000000', linewidth=1.6)
    zero_line(over_v)
    label(over_v, 'Over v, with its mean', '', 'v')
    return figure


def _means_over(v: Array, residual: Array, bins: int = 25) -> tuple[Array, Array]:
    edges = np.linspace(v.min(), v.max(), bins + 1)
    place = np.clip(np.digitize(v, edges) - 1, 0, bins - 1)
    means = np.full(bins, np.nan)
    for i in range(bins):
        inside = residual[(place == i) & np.isfinite(residual)]
        if len(inside) > 3:
            means[i] = inside.mean()
    return 0.5 * (edges[1:] + edges[:-1]), means


def draw_profile(found: Identification, details: Details) -> Figure:
    """RMS of the residual over the gap, whole and near its minimum."""
    figure = new_figure(4.2)
    whole, near = figure.subplots(1, 2)
    gaps = details.profile.gaps
    rms = np.sqrt(details.profile.squares / max(details.profile.best.rows, 1))
    close = np.abs(gaps - found.gap) <= 0.21 * found.gap
    for axes, chosen in ((whole, np.full(len(gaps), True)), (near, close)):
        axes.plot(gaps[chosen], rms[chosen], '.-', color=HUES['m'], markersize=4)
        axes.axvline(found.gap, color=HUES['c_r'], linewidth=1.0)
    whole.set_yscale('log')
    std = found.std['gap']
    near.axvspan(found.gap - SURE * std, found.gap + SURE * std, color=HUES['c_r'], alpha=0.2,
                 linewidth=0)
    label(whole, 'Over the swing of v', 'RMS of the residual', 'gap [v]')
    label(near, f'Near {found.gap:.4g} ± {std:.2g}', '', 'gap [v]')
    return figure


def draw_orders(details: Details) -> Figure:
    """Error on the samples held out, over the order, a line per delay."""
    figure = new_figure(4.2)
    integrators = sorted({one.structure.integrator for one in details.compared})
    rooms = np.atleast_1d(np.asarray(figure.subplots(1, len(integrators), sharey=True)))
    for axes, integrator in zip(rooms.tolist(), integrators, strict=True):
        _draw_orders(axes, details, integrator)
        label(axes, 'With an integrator' if integrator else 'Without integrator',
              'RMS on samples held out' if axes is rooms[0] else '', 'order: number of poles')
    rooms[0].legend(frameon=False, ncol=2, fontsize=9)
    return figure


def _draw_orders(axes: Axes, details: Details, integrator: bool) -> None:
    delays = sorted({one.structure.delay for one in details.compared})
    for delay, colour in zip(delays, _cycled(len(delays)), strict=True):
        line = sorted(
            (one.structure.order, one.held_out, gives_way(one.fit, details.compared))
            for one in details.compared
            if one.structure.delay == delay and one.structure.integrator == integrator
        )
        orders, errors, cancelled = zip(*line, strict=True)
        axes.plot(orders, errors, 'o-', color=colour, markersize=5, alpha=0.8,
                  label=f'delay {delay}')
        axes.plot(orders, errors, 'o', color=colour, markersize=5, markerfacecolor='white',
                  markevery=np.flatnonzero(cancelled).tolist())
    if details.chosen.structure.integrator == integrator:
        axes.plot(details.chosen.structure.order, details.chosen.held_out, 'o', markersize=15,
                  markerfacecolor='none', markeredgecolor='#000000', markeredgewidth=1.5)
    axes.set_yscale('log')
    axes.set_xticks(sorted({one.structure.order for one in details.compared}))


def _cycled(count: int) -> list[str]:
    return [ORDER_COLOURS[i % len(ORDER_COLOURS)] for i in range(count)]


def draw_loop(found: Identification, details: Details) -> Figure:
    """v against y, and v against the u that was found with its two lines."""
    figure = new_figure(4.6)
    left, right = figure.subplots(1, 2)
    v = details.samples.v[-LOOP_POINTS:]
    left.plot(v, details.samples.whole_y[-LOOP_POINTS:], color=HUES['y'], linewidth=0.8)
    label(left, 'As measured', 'y', 'v')
    u = found.m * (details.fit.p[-LOOP_POINTS:] - found.c_r)
    right.plot(v, u, color='#222222', linewidth=1.2, label='u', zorder=3)
    ends = np.array([v.min(), v.max()])
    for name, value in (('c_r', found.c_r), ('c_l', found.c_l)):
        right.plot(ends, found.m * (ends - value), color=HUES[name], linewidth=4.0, alpha=0.5,
                   label=f'{name} = {value:.4g}')
    label(right, 'As found', 'u', 'v')
    right.legend(frameon=False, loc='upper left', fontsize=10)
    return figure
