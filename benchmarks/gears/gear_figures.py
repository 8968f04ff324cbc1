"""Picture of docs/physics.md: hysteresis loops of the presets."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

from gears.gear_runs import PRESETS, quasi_static

mpl.use('Agg')
import matplotlib.pyplot as plt


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
