"""Figure of a sweep: accuracy and settling time over the swept parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite, nan
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from backlash_ros.core.parameters.table import BY_NAME, Value
from backlash_ros.core.simulation.metrics import SETTLING_TOLERANCE
from backlash_ros.tools.pages.drawing import label, legend_below, new_figure
from backlash_ros.tools.simulate.batch import Outcome, Sweep, value_text
from backlash_ros.tools.simulate.statistics import statistics
from backlash_ros.topics import BACKLASH

COLOURS = ('#0072B2', '#D55E00', '#009E73', '#CC79A7', '#E69F00', '#332288', '#777777', '#000000')
MARKERS = 'osD^vP*X'

Groups = Sequence[tuple[Mapping[str, Value], Sequence[Outcome]]]


def draw_sweep(sweeps: Sequence[Sweep], groups: Groups) -> Figure:
    """Relative RMSE of m, c_r, c_l and the settling time of the slowest of them.

    The first swept parameter is the horizontal axis, each combination of the others a line.
    """
    figure = new_figure(7.4)
    # The last row is for the legend: it has room of its own, however many lines there are.
    grid = figure.add_gridspec(3, 2, height_ratios=[1.0, 1.0, 0.01])
    panels = [figure.add_subplot(grid[i, j]) for i in range(2) for j in range(2)]
    axis, *others = sweeps
    numbers = isinstance(axis.values[0], float) or type(axis.values[0]) is int
    places = [float(x) if isinstance(x, (int, float)) and numbers else float(i)
              for i, x in enumerate(axis.values)]
    lines = _lines(axis, others, groups)
    for i, (name, outcomes) in enumerate(lines.items()):
        style: dict[str, Any] = {
            'color': COLOURS[i % len(COLOURS)], 'marker': MARKERS[i % len(MARKERS)],
            'linewidth': 1.6, 'markersize': 6, 'label': name,
        }
        for panel, parameter in zip(panels, BACKLASH, strict=False):
            panel.plot(places, [_rmse_percent(runs, parameter) for runs in outcomes], **style)
        panels[3].plot(places, [_settling(runs) for runs in outcomes], **style)
    for panel, parameter in zip(panels, BACKLASH, strict=False):
        panel.set_yscale('log')
        panel.axhline(
            100.0 * SETTLING_TOLERANCE, color='#444444', linewidth=0.9, linestyle=':')
        label(panel, f'RMSE of ${parameter}$ at the end', '% of the true value')
    label(panels[3], 'Settled within 1 % (median; no point: never)', 'time [s]')
    low, high = panels[3].get_ylim()
    panels[3].set_ylim(0.0, high + 0.1 * (high - low))
    unit = f' [{BY_NAME[axis.name].unit}]' if BY_NAME[axis.name].unit else ''
    for panel in panels:
        panel.set_xlabel(f'{axis.name}{unit}')
        _scale(panel, axis, places, numbers)
        panel.set_xlim(panels[0].get_xlim())
    if others:
        names = ', '.join(sweep.name for sweep in others)
        legend_below(figure.add_subplot(grid[2, :]), panels[0], names)
    return figure


def _lines(
    axis: Sweep, others: Sequence[Sweep], groups: Groups,
) -> dict[str, list[Sequence[Outcome]]]:
    """Outcomes along the axis for each combination of the other parameters."""
    lines: dict[str, list[Sequence[Outcome]]] = {}
    for change, outcomes in groups:
        name = ', '.join(value_text(change[sweep.name]) for sweep in others)
        lines.setdefault(name, []).append(outcomes)
    return lines


def _rmse_percent(outcomes: Sequence[Outcome], parameter: str) -> float:
    whole = [outcome for outcome in outcomes if not outcome.problem]
    if not whole:
        return nan
    i = BACKLASH.index(parameter)
    truth = np.array([outcome.truth[i] for outcome in whole])
    if not truth.all():
        return nan  # nothing is a percentage of zero
    relative = np.array([outcome.final[i] for outcome in whole]) / truth - 1.0
    # The logarithm has no zero.
    return max(100.0 * float(np.sqrt(np.mean(relative**2))), 1e-10)


def _settling(outcomes: Sequence[Outcome]) -> float:
    if all(outcome.problem for outcome in outcomes):
        return nan
    slowest = max((s.settling_median for s in statistics(outcomes).values()), default=inf)
    return slowest if isfinite(slowest) else nan


def _scale(panel: Axes, axis: Sweep, places: Sequence[float], numbers: bool) -> None:
    if not numbers:
        panel.set_xticks(places, [value_text(value) for value in axis.values])
    elif min(places) > 0.0 and max(places) / min(places) >= 20.0:
        panel.set_xscale('log')
