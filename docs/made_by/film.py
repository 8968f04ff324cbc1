"""Makes the film of README.md: a gear without and with compensation, in real time."""

import sys
from dataclasses import replace
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray
from PIL import Image

sys.path.append(str(Path(__file__).resolve().parents[2] / 'benchmarks'))

from gears.gear_runs import PRESETS, Run, close_loop, constant, identified
from reporting import ROOT, save_film

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimate import Status

Array = NDArray[np.float64]

PERIODS = 4  # of a sine with the frequency of the preset
MAGNIFIED = 20.0  # times which angles are drawn larger
FRAME_S = 0.06  # a multiple of 0.01 s, as GIF wants it
WITHOUT_COLOUR, WITH_COLOUR = '#D55E00', '#0072B2'
PART_COLOURS = {'motor': '#cc7a00', 'load': '#1a66cc', 'reference': '#1a1a1a'}


GEAR = replace(PRESETS['servo'], swing=0.04)  # [rad]
PERIOD_S, SINE_S = GEAR.sample_period, 1.0 / GEAR.frequency  # errors are averaged over a sine


class Films(NamedTuple):
    """Both loops. samples: until the reference, which is followed late, is where it began."""

    without: Run
    learned: Run
    samples: int


def run_loops() -> Films:
    """Identify the servo, and close the loop with a gap of 0, for good and to begin with."""
    parameters = identified(GEAR, encoder=False).parameters
    assert parameters is not None
    unknown = parameters.replaced({'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0})
    without = constant(parameters, parameters.estimator.initial.m, 0.0, 0.0)
    runs = [close_loop(GEAR, controller, 'sine', periods=PERIODS + 1)
            for controller in (without, build_controller(unknown))]
    return Films(*runs, round(PERIODS * SINE_S / PERIOD_S) + without.structure.delay)


class View:
    """A gear from the front: a motor with a fork, a load with a pin in it, and the reference."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        axes.axis('off')
        axes.set(xlim=(-1.4, 1.4), ylim=(-1.05, 1.05), aspect='equal')
        axes.add_patch(Circle((0.0, 0.0), 1.02, color='#edf0f2'))
        step = radians(MAGNIFIED)  # one for each degree as it is
        for k in range(-round(0.5 * pi / step), round(0.5 * pi / step) + 1):
            x, y = sin(k * step), cos(k * step)
            axes.plot((0.95 * x, x), (0.95 * y, y), color='#73808c', linewidth=2.0)
        # The pin touches a prong once the angle between motor and load is half of the gap.
        pin, pin_at, prong = 0.04, 0.47, 0.03
        beside = pin + pin_at * sin(0.5 * PRESETS['servo'].gap * MAGNIFIED) + prong
        motor, load, reference = PART_COLOURS.values()
        self._parts = {'motor': [
            Circle((0.0, 0.0), 0.19, color=motor),
            _box(0.0, -0.22, beside + prong, 0.05, motor),
            *(_box(side * beside, -0.42, prong, 0.18, motor) for side in (-1.0, 1.0)),
        ], 'load': [
            _box(0.0, 0.43, 0.03, 0.43, load), Circle((0.0, 0.0), 0.11, color=load),
            _box(0.0, -0.5 * pin_at, 0.03, 0.5 * pin_at, load),
            Circle((0.0, -pin_at), pin, color=load),
        ], 'reference': [
            _box(0.0, 0.49, 0.007, 0.49, reference), _box(0.0, 0.95, 0.035, 0.05, reference),
        ]}
        for patch in (patch for patches in self._parts.values() for patch in patches):
            axes.add_patch(patch)

    def turn(self, part: str, angle: float) -> None:
        """Show a part at an angle [rad], clockwise."""
        turned = Affine2D().rotate(-MAGNIFIED * angle) + self._axes.transData
        for patch in self._parts[part]:
            patch.set_transform(turned)


def _box(x: float, y: float, half_width: float, half_height: float, colour: str) -> Patch:
    return Rectangle((x - half_width, y - half_height), 2.0 * half_width, 2.0 * half_height,
                     color=colour)


class Frames:
    def __init__(self, films: Films) -> None:
        figure = Figure((8.0, 5.2), dpi=100)
        self._canvas = FigureCanvasAgg(figure)
        self._word = figure.text(0.98, 0.36, '', fontsize=11.5, weight='bold', ha='right')
        for x, (part, colour) in zip((0.43, 0.5, 0.58), PART_COLOURS.items(), strict=True):
            figure.text(x, 0.445, part, color=colour, fontsize=11, ha='center')
        axes = figure.add_axes((0.085, 0.105, 0.895, 0.235))
        self._t, self._status = PERIOD_S * np.arange(films.samples), films.learned.status
        reach = 1.15 * max(float(np.abs(_error(run)).max()) for run in films[:2])
        axes.axhline(0.0, color='0.7', linewidth=0.8)
        axes.set(xlim=(0.0, self._t[-1]), ylim=(-reach, reach), xlabel='time [s]',
                 yticks=(-0.4, 0.0, 0.4))
        axes.set_ylabel('load − reference [°]', y=0.35)
        self._parts: list[tuple[Run, View, Any, Any]] = []  # with the text and the curve of each
        for run, left, colour, name in (
            (films.without, 0.0, WITHOUT_COLOUR, 'without compensation'),
            (films.learned, 0.5, WITH_COLOUR, 'with backlash_ros'),
        ):
            figure.text(left + 0.25, 0.945, name, color=colour, fontsize=15, ha='center',
                        weight='bold')
            self._parts.append((run, View(figure.add_axes((left, 0.4, 0.5, 0.53))),
                                figure.text(left + 0.05, 0.36, '', color=colour, fontsize=11.5),
                                axes.plot([], [], color=colour, linewidth=1.8)[0]))

    def draw(self, k: int) -> Image.Image:
        """The picture at sample k, with the errors over the last period, or as much as there is."""
        begin = max(k - round(SINE_S / PERIOD_S), 0)
        for run, view, text, curve in self._parts:
            for part, angles in (('motor', run.motor), ('load', run.y), ('reference', run.y_m)):
                view.turn(part, angles[k])
            error = _error(run)
            rms = np.sqrt(np.mean(error[begin:k + 1]**2))
            text.set_text(f'RMS error of the last {SINE_S:g} s: {rms:.3f}°')
            curve.set_data(self._t[:k + 1], error[:k + 1])
        self._word.set_text(Status(self._status[k]).word)
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert('RGB')


def _error(run: Run) -> Array:
    return np.degrees(run.y - run.y_m)


def main() -> None:
    films = run_loops()
    frames = Frames(films)
    pictures = [frames.draw(k) for k in range(0, films.samples, round(FRAME_S / PERIOD_S))]
    sample = np.hstack([np.asarray(one) for one in pictures[::len(pictures) // 8]])
    palette = Image.fromarray(sample).quantize(48, Image.Quantize.MAXCOVERAGE)
    save_film(ROOT / 'docs' / 'images' / 'gear.gif', pictures, palette, FRAME_S, 2.0)


if __name__ == '__main__':
    main()
