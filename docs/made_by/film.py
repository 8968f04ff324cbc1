"""Makes the film of README.md: a gear without and with compensation, in real time."""

import sys
from dataclasses import replace
from math import cos, pi, radians, sin
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / 'benchmarks'))

import numpy as np
from gears.gear_runs import PRESETS, close_loop, constant, identified
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.transforms import Affine2D
from PIL import Image
from reporting import ROOT, save_film

from backlash_ros.core import Status, build_controller

GEAR = replace(PRESETS['servo'], swing=0.04)  # [rad]
PERIOD_S, SINE_S = GEAR.sample_period, 1.0 / GEAR.frequency  # errors are averaged over a sine
PERIODS = 4  # of a sine with the frequency of the preset
MAGNIFIED = 20.0  # times which angles are drawn larger
FRAME_S = 0.06  # a multiple of 0.01 s, as GIF wants it
SIDES = ((0.0, '#D55E00', 'without compensation'), (0.5, '#0072B2', 'with backlash_ros'))
MOTOR, LOAD, REFERENCE = '#cc7a00', '#1a66cc', '#1a1a1a'


class View:
    """A gear from the front: a motor with a fork, a load with a pin in it, and the reference."""

    def __init__(self, axes: Axes) -> None:
        self._axes = axes
        axes.axis('off')
        axes.set(xlim=(-1.4, 1.4), ylim=(-1.05, 1.05), aspect='equal')
        axes.add_patch(Circle((0.0, 0.0), 1.02, color='#edf0f2'))
        ticks = round(0.5 * pi / radians(MAGNIFIED))  # one for each degree as it is
        for angle in radians(MAGNIFIED) * np.arange(-ticks, ticks + 1):
            x, y = sin(angle), cos(angle)
            axes.plot((0.95 * x, x), (0.95 * y, y), color='#73808c', linewidth=2.0)
        # The pin touches a prong once the angle between motor and load is half of the gap.
        beside = 0.07 + 0.47 * sin(0.5 * GEAR.gap * MAGNIFIED)
        # Middle, half width and height of boxes, or the radius of a circle.
        self._parts = [[self._drawn(colour, *shape) for shape in shapes] for colour, shapes in (
            (MOTOR, ((0.0, 0.0, 0.19), (0.0, -0.22, beside + 0.03, 0.05),
                     (-beside, -0.42, 0.03, 0.18), (beside, -0.42, 0.03, 0.18))),
            (LOAD, ((0.0, 0.43, 0.03, 0.43), (0.0, 0.0, 0.11), (0.0, -0.235, 0.03, 0.235),
                    (0.0, -0.47, 0.04))),
            (REFERENCE, ((0.0, 0.49, 0.007, 0.49), (0.0, 0.95, 0.035, 0.05))))]

    def _drawn(self, colour: str, x: float, y: float, w: float, h: float = 0.0) -> Patch:
        return self._axes.add_patch(
            Rectangle((x - w, y - h), 2.0 * w, 2.0 * h, color=colour) if h
            else Circle((x, y), w, color=colour))

    def turn(self, *angles: float) -> None:
        for patches, angle in zip(self._parts, angles, strict=True):
            for patch in patches:
                patch.set_transform(Affine2D().rotate(-MAGNIFIED * angle) + self._axes.transData)


def main() -> None:
    """Identify the servo, close the loop with a gap of 0, for good and to begin with, and draw."""
    parameters = identified(GEAR, encoder=False).parameters
    assert parameters is not None
    unknown = parameters.replaced({'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0})
    without = constant(parameters, parameters.estimator.initial.m, 0.0, 0.0)
    runs = [close_loop(GEAR, controller, 'sine', periods=PERIODS + 1)
            for controller in (without, build_controller(unknown))]
    # Until the reference, which is followed late, is where it began.
    t = PERIOD_S * np.arange(round(PERIODS * SINE_S / PERIOD_S) + without.structure.delay)
    errors = [np.degrees(run.y - run.y_m) for run in runs]

    figure = Figure((8.0, 5.2), dpi=100)
    canvas = FigureCanvasAgg(figure)
    word = figure.text(0.98, 0.36, '', fontsize=11.5, weight='bold', ha='right')
    for x, part, colour in ((0.43, 'motor', MOTOR), (0.5, 'load', LOAD),
                            (0.58, 'reference', REFERENCE)):
        figure.text(x, 0.445, part, color=colour, fontsize=11, ha='center')
    axes, reach = figure.add_axes((0.085, 0.105, 0.895, 0.235)), 1.15 * np.abs(errors).max()
    axes.axhline(0.0, color='0.7', linewidth=0.8)
    axes.set(xlim=(0.0, t[-1]), ylim=(-reach, reach), xlabel='time [s]', yticks=(-0.4, 0.0, 0.4))
    axes.set_ylabel('load − reference [°]', y=0.35)
    views, texts, curves = [], [], []
    for left, colour, name in SIDES:
        figure.text(left + 0.25, 0.945, name, color=colour, fontsize=15, ha='center', weight='bold')
        views.append(View(figure.add_axes((left, 0.4, 0.5, 0.53))))
        texts.append(figure.text(left + 0.05, 0.36, '', color=colour, fontsize=11.5))
        curves += axes.plot([], [], color=colour, linewidth=1.8)
    pictures = []
    for k in range(0, len(t), round(FRAME_S / PERIOD_S)):
        for run, error, view, text, curve in zip(runs, errors, views, texts, curves, strict=True):
            view.turn(run.motor[k], run.y[k], run.y_m[k])
            lately = error[max(k - round(SINE_S / PERIOD_S), 0):k + 1]
            rms = np.sqrt(np.mean(lately**2))
            text.set_text(f'RMS error of the last {SINE_S:g} s: {rms:.3f}°')
            curve.set_data(t[:k + 1], error[:k + 1])
        word.set_text(Status(runs[1].status[k]).word)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert('RGB'))
    sample = np.hstack([np.asarray(one) for one in pictures[::len(pictures) // 8]])
    palette = Image.fromarray(sample).quantize(48, Image.Quantize.MAXCOVERAGE)
    save_film(ROOT / 'docs' / 'images' / 'gear.gif', pictures, palette, FRAME_S, 2.0)


if __name__ == '__main__':
    main()
