"""Makes the film of README.md: a gear without and with compensation, in real time.

It needs libOSMesa, which draws without a display (apt-get install libosmesa6).
"""

from __future__ import annotations

import os
import sys
from ctypes.util import find_library
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / 'benchmarks'))
os.environ.setdefault('MUJOCO_GL', 'osmesa')  # mujoco reads it when it is imported
if os.environ['MUJOCO_GL'] == 'osmesa' and find_library('OSMesa') is None:
    sys.exit('make docs: no libOSMesa to draw the film of README.md with: '
             'apt-get install libosmesa6, or set MUJOCO_GL to egl or glfw')

from film_scene import Scene  # noqa: E402
from gears.gear_runs import PRESETS, Run, close_loop, constant, identified  # noqa: E402

from backlash_ros.core.assembly import build_controller  # noqa: E402
from backlash_ros.core.estimate import Status  # noqa: E402

FILE = ROOT / 'docs' / 'images' / 'gear.gif'
SWING, PERIODS = 0.04, 4  # [rad], of a sine with the frequency of the preset
MAGNIFIED = 20.0  # times which angles are drawn larger
FRAME_S, HELD_S = 0.06, 2.0  # a multiple of 0.01 s each, as GIF wants it; of the last frame
WIDTH, HEIGHT, PIXELS_PER_INCH = 800, 520, 100
VIEW = (400, 300)  # pixels
FINER = 2  # times which a view is drawn larger, and reduced: smooth edges
COLOURS = 48  # of the palette: without dithering, which would not compress
WITHOUT_COLOUR, WITH_COLOUR = '#D55E00', '#0072B2'
# Place, colour and name of what is drawn.
PARTS = ((0.43, '#cc7a00', 'motor'), (0.5, '#1a66cc', 'load'), (0.58, '#1a1a1a', 'reference'))
DEGREE = np.pi / 180.0


@dataclass(frozen=True)
class Films:
    """Both loops. samples: until the reference, which is followed late, is where it began.

    sine_s: period of the reference, over which errors are averaged.
    """

    without: Run
    learned: Run
    samples: int
    sample_period: float
    sine_s: float

    def rms(self, run: Run, until: int) -> float:
        """Error [degrees] over the last period before that sample, or as much as there is."""
        first = max(until - round(self.sine_s / self.sample_period), 0)
        return float(np.sqrt(np.mean((run.y - run.y_m)[first:until + 1]**2))) / DEGREE


def run_loops() -> Films:
    """Identify the servo, and close the loop with a gap of 0, for good and to begin with."""
    gear = replace(PRESETS['servo'], swing=SWING)
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


class Frames:
    """Draws one moment after the other."""

    def __init__(self, films: Films) -> None:
        gear = PRESETS['servo']
        self._films = films
        self._scene = Scene(gear.gap, MAGNIFIED, *(FINER * size for size in VIEW))
        self._figure = Figure((WIDTH / PIXELS_PER_INCH, HEIGHT / PIXELS_PER_INCH),
                              dpi=PIXELS_PER_INCH)
        self._canvas = FigureCanvasAgg(self._figure)
        blank = np.full((VIEW[1], VIEW[0], 3), 255, np.uint8)
        share = VIEW[1] / HEIGHT
        self._views, self._texts = [], []
        for left, colour, name in (
            (0.0, WITHOUT_COLOUR, 'without compensation'), (0.5, WITH_COLOUR, 'with backlash_ros'),
        ):
            axes = self._figure.add_axes((left, 0.93 - share, 0.5, share))
            axes.axis('off')
            self._views.append(axes.imshow(blank, interpolation='none'))
            self._figure.text(left + 0.25, 0.945, name, color=colour, fontsize=15,
                              ha='center', weight='bold')
            self._texts.append(self._figure.text(
                left + 0.05, 0.36, '', color=colour, fontsize=11.5,
            ))
        self._word = self._figure.text(0.88, 0.36, '', fontsize=11.5, weight='bold')
        axes = self._figure.add_axes((0.085, 0.105, 0.895, 0.235))
        self._curves = _draw_axes(axes, films)
        for x, colour, part in PARTS:
            self._figure.text(x, 0.445, part, color=colour, fontsize=11, ha='center')

    def draw(self, k: int) -> Image.Image:
        """The picture at sample k."""
        films = self._films
        for run, view, text in zip(
            (films.without, films.learned), self._views, self._texts, strict=True
        ):
            drawn = Image.fromarray(self._scene.draw(run.y_m[k], run.motor[k], run.y[k]))
            view.set_data(drawn.reduce(FINER))
            text.set_text(f'RMS error of the last {films.sine_s:g} s: {films.rms(run, k):.3f}°')
        self._word.set_text(Status(films.learned.status[k]).word)
        for run, curve in zip((films.without, films.learned), self._curves, strict=True):
            curve.set_data(_seconds(films)[:k + 1], _error(run)[:k + 1])
        self._canvas.draw()
        return Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert('RGB')

    def close(self) -> None:
        """Give the renderer back."""
        self._scene.close()


def _draw_axes(axes: Axes, films: Films) -> list[Any]:
    """The axes of the errors; returns the curves that grow."""
    t = _seconds(films)
    reach = 1.15 * max(
        float(np.abs(_error(run)).max()) for run in (films.without, films.learned)
    )
    axes.axhline(0.0, color='0.7', linewidth=0.8)
    axes.set(xlim=(0.0, t[-1]), ylim=(-reach, reach), xlabel='time [s]', yticks=(-0.4, 0.0, 0.4))
    axes.set_ylabel('load − reference [°]', y=0.35)
    return [
        axes.plot([], [], color=colour, linewidth=1.8)[0]
        for colour in (WITHOUT_COLOUR, WITH_COLOUR)
    ]


def _seconds(films: Films) -> NDArray[np.float64]:
    return films.sample_period * np.arange(films.samples)


def _error(run: Run) -> NDArray[np.float64]:
    return (run.y - run.y_m) / DEGREE


def main() -> None:
    """Write the film."""
    films = run_loops()
    every = round(FRAME_S / films.sample_period)
    frames = Frames(films)
    pictures = [frames.draw(k) for k in range(0, films.samples, every)]
    frames.close()
    # One palette for all, from frames throughout: else colours would flicker.
    sample = np.hstack([np.asarray(one) for one in pictures[::len(pictures) // 8]])
    palette = Image.fromarray(sample).quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    still = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    still[0].save(
        FILE, save_all=True, append_images=still[1:], loop=0, optimize=False,
        duration=[round(1e3 * FRAME_S)] * (len(still) - 1) + [round(1e3 * HELD_S)],
    )


if __name__ == '__main__':
    main()
