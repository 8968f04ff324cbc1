"""Pictures of docs/physics.md: hysteresis loops of the presets, and the map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from gears.gear_map import BANDWIDTH, INERTIA, OFF, Cell
from gears.gear_runs import PRESETS, quasi_static

mpl.use('Agg')
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch, Rectangle

# Errors of the gap [%]: shades of blue up to OFF, of orange beyond.
STEPS = (0.0, 2.0, 5.0, 100.0 * OFF, 20.0, 50.0, 1e9)
COLOURS = ('#e3eef8', '#b3d2e9', '#74aed4', '#fdd0a2', '#fd9a4e', '#d95f0e')
# What is said: hatching, and what that means for `identify` and for the loop.
KINDS = {
    'tracking': ('', 'of use; tracking'),
    'other': ('///', 'not of use; not tracking'),
    'coasts': ('ooo', 'the load coasts'),
}
HOLDS = 0.7  # J |a| / friction up to which the model holds


def draw_hysteresis(path: Path) -> None:
    """Hysteresis loops of all presets, behind the command and behind the motor."""
    figure, axes = plt.subplots(2, len(PRESETS), figsize=(15, 6), constrained_layout=True)
    for (above, below), (name, gear) in zip(axes.T, PRESETS.items(), strict=True):
        v, motor, load = quasi_static(gear)
        for x, label in ((v, 'command'), (motor, 'motor')):
            above.plot(x, load, label=label)
            below.plot(x, x - load)
        half = 0.5 * gear.scale * gear.gap
        for y in (-half, half):
            below.axhline(y, color='0.6', linestyle=':', zorder=0)
        above.set_title(name)
        below.set_xlabel('v [mm]' if gear.linear else 'v [rad]')
    axes[0, 0].set_ylabel('load')
    axes[1, 0].set_ylabel('v − load; gap dotted')
    axes[0, 0].legend()
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_map(cells: Sequence[Cell], path: Path) -> None:
    """The square map: errors of the gap as colours, what is said as hatching, x: wrong."""
    side = round(len(cells)**0.5)
    figure, axes = plt.subplots(
        1, 2, figsize=(11, 5.4), sharex=True, sharey=True, constrained_layout=True
    )
    edges = [_edges(*reach, side) for reach in (INERTIA, BANDWIDTH)]
    for one, title, errors, said in zip(
        axes, ('identify', 'the loop, at its end'),
        ([cell.identified for cell in cells], [cell.gap for cell in cells]),
        ([cell.identify_says for cell in cells], [cell.loop_says for cell in cells]), strict=True,
    ):
        _draw_errors(one, edges, 100.0 * np.abs(np.array(errors) - 1.0), said)
        one.set_title(title)
        one.set_xlabel('J |a| / τ_c of the motion')
    axes[0].set_ylabel('bandwidth of the position loop / frequency of the motion')
    for k, cell in enumerate(cells):
        if cell.wrong:
            x, y = (np.sqrt(e[i] * e[i + 1]) for e, i in zip(edges, (k % side, k // side),
                                                             strict=True))
            axes[1].plot(x, y, 'x', color='black', markersize=11, markeredgewidth=3)
    colours = [
        Patch(facecolor=colour, edgecolor='0.5', label=_range(low, high))
        for colour, low, high in zip(COLOURS, STEPS, STEPS[1:], strict=False)
    ]
    hatches = [
        Patch(facecolor='white', edgecolor='0.3', hatch=hatch, label=text)
        for hatch, text in KINDS.values()
    ]
    cross = plt.Line2D([], [], color='black', marker='x', linestyle='', markeredgewidth=3,
                       label=f'said tracking, off by > {OFF:.0%}')
    figure.legend(handles=colours, title='error of the gap', loc='outside right upper')
    holds = plt.Line2D([], [], color='black', linestyle='--', linewidth=1.2,
                       label=f'J |a| / τ_c = {HOLDS:g}')
    figure.legend(handles=[*hatches, cross, holds], title='says', loc='outside right lower')
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _draw_errors(
    axes: Axes, edges: list[np.ndarray], errors: np.ndarray, said: Sequence[str],
) -> None:
    across, down = edges
    side = len(across) - 1
    axes.pcolormesh(
        across, down, np.ma.masked_invalid(errors).reshape(side, side),
        cmap=ListedColormap(COLOURS), norm=BoundaryNorm(STEPS, len(COLOURS)), edgecolors='white',
    )
    for k, kind in enumerate(said):
        i, j = k % side, k // side
        axes.add_patch(Rectangle(
            (across[i], down[j]), across[i + 1] - across[i], down[j + 1] - down[j],
            fill=False, linewidth=0.0, edgecolor='0.3', hatch=KINDS[kind][0],
        ))
    axes.axvline(HOLDS, color='black', linestyle='--', linewidth=1.2)
    axes.set(xscale='log', yscale='log', xlim=across[[0, -1]], ylim=down[[0, -1]])
    for axis, ticks in ((axes.xaxis, (0.01, 0.1, 1, 10)), (axes.yaxis, (2, 5, 10, 20, 50, 100))):
        axis.set_ticks(ticks, [f'{tick:g}' for tick in ticks])
        axis.set_minor_locator(plt.NullLocator())


def _edges(low: float, high: float, side: int) -> np.ndarray:
    """Borders of cells whose middles are spread evenly over a logarithmic scale."""
    half = 0.5 * np.log(high / low) / max(side - 1, 1)
    return np.exp(np.linspace(np.log(low) - half, np.log(high) + half, side + 1))


def _range(low: float, high: float) -> str:
    return f'> {low:g} %' if high == STEPS[-1] else f'{low:g} to {high:g} %'
