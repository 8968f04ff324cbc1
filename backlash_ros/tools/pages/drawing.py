"""Look of the figures: colours of the quantities, axes, legends beside the data, saving."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from backlash_ros.tools.report.analysis import thinned

Array = NDArray[np.float64]

TIME = 'time t [s]'  # label of an axis
# Okabe-Ito and Tol: told apart with every kind of colour vision.
COLOURS = {
    'm': '#0072B2', 'c_r': '#D55E00', 'c_l': '#009E73',
    'u': '#000000', 'u_d': '#E69F00', 'v': '#CC79A7', 'y': '#332288', 'y_m': '#777777',
    'e': '#882255', 'true': '#000000',
}
LAW_COLOURS = {'moving_horizon': '#44AA99', 'lms': '#AA4499', 'printed': '#999933'}
OTHER_LAW = '#555555'
ESTIMATES = {'m': r'\hat{m}', 'c_r': r'\hat{c}_r', 'c_l': r'\hat{c}_l'}
STYLES = {'m': '-', 'c_r': '--', 'c_l': '-.'}
UNITS = {'m': 'unit of u/v', 'c_r': 'unit of v', 'c_l': 'unit of v'}


def new_figure(height: float) -> Figure:
    """Figure of the common width that needs no display."""
    return Figure(figsize=(10.0, height), dpi=130, layout='constrained')


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    # savefig would lay it out, and go through all there is to draw, once more.
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def label(axes: Axes, title: str = '', y: str = '', x: str = '') -> None:
    """Set title (at the left, so that a legend fits beside it) and labels with units."""
    if title:
        axes.set_title(title, loc='left', fontsize=11, fontweight='bold')
    if x:
        axes.set_xlabel(x)
    if y:
        axes.set_ylabel(y)
    axes.grid(True, color='#dddddd', linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)


def legend_above(axes: Axes) -> None:
    """Put the legend in one row above the axes, at the right."""
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(
        handles, labels, loc='lower right', bbox_to_anchor=(1.0, 1.0), ncol=len(labels),
        frameon=False, fontsize=10, borderaxespad=0.1, handlelength=2.2, columnspacing=1.4,
    )


def legend_below(room: Axes, axes: Axes, title: str = '') -> None:
    """Put the legend of axes into a room of its own, four entries in a row."""
    room.axis('off')
    handles, labels = axes.get_legend_handles_labels()
    room.legend(handles, labels, title=title or None, loc='upper center', ncol=4, frameon=False)


def plain_numbers(axes: Axes) -> None:
    """Write the whole number at each tick of y, not a common factor above the axis."""
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: f'{value:.6g}'.replace('-', '\N{MINUS SIGN}'))
    )


def limit_decades(axes: Axes, lowest: float, highest: float, decades: float) -> None:
    """Make y logarithmic over at most so many decades below the highest value."""
    axes.set_yscale('log')
    if 0.0 < highest < np.inf:
        axes.set_ylim(max(lowest, highest * 10.0**-decades) * 0.6, highest * 1.7)


def curve(
    axes: Axes, t: Array, values: Array, colour: str, name: str = '', style: str = '-',
    width: float = 1.3, alpha: float = 1.0,
) -> None:
    """Draw one signal over time."""
    axes.plot(*thinned(t, values), color=colour, linestyle=style, linewidth=width, alpha=alpha,
              label=name or '_')


def zero_line(axes: Axes) -> None:
    """Draw a thin line at y = 0."""
    axes.axhline(0.0, color='#444444', linewidth=0.8)


def band(axes: Axes, t: Array, low: Array, high: Array, colour: str, name: str = '') -> None:
    """Fill between two signals over time, where both are known."""
    step = max(len(t) // 2000, 1)
    axes.fill_between(
        t[::step], low[::step], high[::step], color=colour, alpha=0.18, linewidth=0,
        label=name or '_',
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
