"""Makes the film of README.md: a gear without and with compensation, in real time."""

from __future__ import annotations

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

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / 'benchmarks'))

from gears.gear_runs import PRESETS, Run, close_loop, constant, identified  # noqa: E402

from backlash_ros.core.assembly import build_controller  # noqa: E402
from backlash_ros.core.estimate import Status  # noqa: E402

Array = NDArray[np.float64]

PERIODS = 4  # of a sine with the frequency of the preset
MAGNIFIED = 20.0  # times which angles are drawn larger
FRAME_S = 0.06  # a multiple of 0.01 s, as GIF wants it
WITHOUT_COLOUR, WITH_COLOUR = '#D55E00', '#0072B2'
PART_COLOURS = {'motor': '#cc7a00', 'load': '#1a66cc', 'reference': '#1a1a1a'}


class Films(NamedTuple):
    """Both loops. samples: until the reference, which is followed late, is where it began."""

    without: Run
    learned: Run
    samples: int
    sample_period: float
    sine_s: float  # period of the reference, over which errors are averaged

    @property
    def seconds(self) -> Array:
        """Time of each sample, shape (N,)."""
        return self.sample_period * np.arange(self.samples)


def run_loops() -> Films:
    """Identify the servo, and close the loop with a gap of 0, for good and to begin with."""
    gear = replace(PRESETS['servo'], swing=0.04)  # [rad]
    parameters = identified(gear, encoder=False).parameters
    assert parameters is not None
    unknown = parameters.replaced({'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0})
    without = constant(parameters, parameters.estimator.initial.m, 0.0, 0.0)
    runs = [
        close_loop(gear, controller, 'sine', periods=PERIODS + 1)
        for controller in (without, build_controller(unknown))
    ]
    samples = round(PERIODS / gear.frequency / gear.sample_period) + without.structure.delay
    return Films(*runs, samples, gear.sample_period, 1.0 / gear.frequency)


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
    """Draws one moment after the other."""

    def __init__(self, films: Films) -> None:
        self._films = films
        self._figure = Figure((8.0, 5.2), dpi=100)
        self._canvas = FigureCanvasAgg(self._figure)
        self._views, self._texts = [], []
        for left, colour, name in (
            (0.0, WITHOUT_COLOUR, 'without compensation'), (0.5, WITH_COLOUR, 'with backlash_ros'),
        ):
            self._views.append(View(self._figure.add_axes((left, 0.4, 0.5, 0.53))))
            self._figure.text(left + 0.25, 0.945, name, color=colour, fontsize=15,
                              ha='center', weight='bold')
            self._texts.append(self._figure.text(
                left + 0.05, 0.36, '', color=colour, fontsize=11.5,
            ))
        self._word = self._figure.text(0.98, 0.36, '', fontsize=11.5, weight='bold', ha='right')
        self._curves = _draw_axes(self._figure.add_axes((0.085, 0.105, 0.895, 0.235)), films)
        for x, (part, colour) in zip((0.43, 0.5, 0.58), PART_COLOURS.items(), strict=True):
            self._figure.text(x, 0.445, part, color=colour, fontsize=11, ha='center')

    def draw(self, k: int) -> Image.Image:
        """The picture at sample k, with the errors over the last period, or as much as there is."""
        films = self._films
        begin = max(k - round(films.sine_s / films.sample_period), 0)
        for run, view, text, curve in zip(
            (films.without, films.learned), self._views, self._texts, self._curves, strict=True
        ):
            for part, angles in (('motor', run.motor), ('load', run.y), ('reference', run.y_m)):
                view.turn(part, angles[k])
            error = _error(run)
            rms = np.sqrt(np.mean(error[begin:k + 1]**2))
            text.set_text(f'RMS error of the last {films.sine_s:g} s: {rms:.3f}°')
            curve.set_data(films.seconds[:k + 1], error[:k + 1])
        self._word.set_text(Status(films.learned.status[k]).word)
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert('RGB')


def _draw_axes(axes: Axes, films: Films) -> list[Any]:
    """The axes of the errors; returns the curves that grow."""
    reach = 1.15 * max(float(np.abs(_error(run)).max()) for run in (films.without, films.learned))
    axes.axhline(0.0, color='0.7', linewidth=0.8)
    axes.set(xlim=(0.0, films.seconds[-1]), ylim=(-reach, reach), xlabel='time [s]',
             yticks=(-0.4, 0.0, 0.4))
    axes.set_ylabel('load − reference [°]', y=0.35)
    return [
        axes.plot([], [], color=colour, linewidth=1.8)[0]
        for colour in (WITHOUT_COLOUR, WITH_COLOUR)
    ]


def _error(run: Run) -> Array:
    return np.degrees(run.y - run.y_m)


def main() -> None:
    """Write the film."""
    films = run_loops()
    frames = Frames(films)
    pictures = [
        frames.draw(k) for k in range(0, films.samples, round(FRAME_S / films.sample_period))
    ]
    # One palette for all, from frames throughout: else colours would flicker; no dithering, which
    # would not compress.
    sample = np.hstack([np.asarray(one) for one in pictures[::len(pictures) // 8]])
    palette = Image.fromarray(sample).quantize(48, Image.Quantize.MAXCOVERAGE)
    still = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    still[0].save(
        ROOT / 'docs' / 'images' / 'gear.gif', save_all=True, append_images=still[1:], loop=0,
        optimize=False, duration=[round(1e3 * FRAME_S)] * (len(still) - 1) + [2000],
    )


if __name__ == '__main__':
    main()
