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
from backlash_ros.topics import BACKLASH


def draw_replay(recorded: RunRecord, replayed: RunRecord) -> Figure:
    """m, c_r, c_l, innovation and status over time; grey: as the run had them."""
    figure = new_figure(10.0)
    rooms = figure.subplots(5, 1, sharex=True, height_ratios=[1.0, 1.0, 1.0, 1.0, 0.5])
    t = replayed.column('t')
    own_colour = HUES['y_m']
    for axes, name in zip(rooms, BACKLASH, strict=False):
        own, again = recorded.column(name), replayed.column(name)
        std = replayed.column(f'std_{name}')
        if np.isfinite(own).any():
            curve(axes, t, own, own_colour, 'run', width=2.6)
        curve(axes, t, again, HUES[name], 'replay')
        band(axes, t, again - std, again + std, HUES[name])
        low, high = np.nanpercentile(np.concatenate([own, again]), [1.0, 99.0])
        room = 0.2 * (high - low) or 0.1 * max(abs(high), 1e-9)
        axes.set_ylim(low - room, high + room)
        label(axes, '', f'${HATS[name]}$ [{BACKLASH_UNITS[name]}]')
    legend_above(rooms[0])
    for run, colour, width in ((recorded, own_colour, 2.6), (replayed, HUES['e'], 1.3)):
        curve(rooms[3], t, run.column('innovation'), colour, width=width)
        rooms[4].step(t, run.column('status'), where='post', color=colour, linewidth=width)
    label(rooms[3], '', 'innovation [y]')
    rooms[4].set_yticks([int(state) for state in Status], [state.word for state in Status])
    label(rooms[4], '', '', 'time t [s]')
    return figure
