"""The figure of a replay: estimates, status and innovation against those of the run."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from backlash_ros.core.estimate import Status
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.figures import (
    BACKLASH_UNITS,
    HATS,
    HUES,
    band,
    curve,
    label,
    legend_above,
    new_figure,
)

OWN = '#777777'


def draw_replay(recorded: RunRecord, replayed: RunRecord) -> Figure:
    """m, c_r, c_l, innovation and status over time; grey: as the run had them."""
    figure = new_figure(10.0)
    rooms = figure.subplots(5, 1, sharex=True, height_ratios=[1.0, 1.0, 1.0, 1.0, 0.5])
    t = replayed.column('t')
    for axes, name in zip(rooms, ('m', 'c_r', 'c_l'), strict=False):
        own, again = recorded.column(name), replayed.column(name)
        curve(axes, t, own, OWN, 'run', width=2.6)
        curve(axes, t, again, HUES[name], 'replay')
        std = replayed.column(f'std_{name}')
        band(axes, t, again - std, again + std, HUES[name])
        both = np.concatenate([own, again])
        low, high = np.nanpercentile(both, [1.0, 99.0])
        room = 0.2 * (high - low) or 0.1 * max(abs(high), 1e-9)
        axes.set_ylim(low - room, high + room)
        label(axes, '', f'${HATS[name]}$ [{BACKLASH_UNITS[name]}]')
    legend_above(rooms[0])
    curve(rooms[3], t, recorded.column('innovation'), OWN, width=1.6)
    curve(rooms[3], t, replayed.column('innovation'), HUES['e'])
    label(rooms[3], '', 'innovation [y]')
    for run, colour, width in ((recorded, OWN, 2.6), (replayed, HUES['e'], 1.3)):
        rooms[4].step(t, run.column('status'), where='post', color=colour, linewidth=width)
    rooms[4].set_yticks([int(state) for state in Status], [state.word for state in Status])
    label(rooms[4], '', '', 'time t [s]')
    return figure
