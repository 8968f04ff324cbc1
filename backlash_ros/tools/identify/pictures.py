"""The pictures of identify.html: a person judges by them whether the result is to be trusted."""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.identification.model import autocorrelation
from backlash_ros.tools import figures
from backlash_ros.tools.figures import HUES, TIME_LABEL, curve, label
from backlash_ros.tools.page import Picture

BAND_STDS = 2.0  # standard deviations that bands reach


def pictures(found: Identification) -> Iterator[Picture]:
    """Every picture, in the order of the page; none where nothing was fitted."""
    for name, heading, caption, height, draw in (
        ('held_out.png', 'Measured and simulated y on samples that were held out',
         'Simulated from v alone, with a model that was fitted to the samples before: the lines '
         'should lie on each other, and the difference should look like noise.',
         6.2, _held_out),
        ('loop.png', 'The backlash',
         'Left: y over v as measured. Right: what the backlash that was found takes from v, over '
         'v: c<sub>r</sub> while v pushes to the right, c<sub>l</sub> to the left, and in between '
         'while v crosses the gap after each turn.', 4.6, _loop),
        ('residual.png', 'Residual of the fit',
         'y minus the simulation of the whole record. Its autocorrelation should stay within the '
         'band of white noise; the rounding of an encoder may leave it. Over v it should show no '
         'shape: a slope or a hook is a nonlinearity that is not in the model.',
         6.6, _residual),
        ('bode.png', 'Frequency response of m G',
         'How much and how late y answers to u, with a band of two standard deviations. Between '
         'the dotted lines y moved; outside of them the record says little.', 5.6, _bode),
    ):
        if found.details is not None:
            figure = Figure(figsize=(10.0, height), constrained_layout=False)
            # Margins that suit all of them: a layout takes as long as to draw it.
            figure.subplots_adjust(left=0.1, right=0.985, bottom=0.55 / height,
                                   top=1.0 - 0.4 / height, wspace=0.2, hspace=0.4)
            draw(figure, found, found.details)
            yield Picture(name, heading, caption, figures.png(figure))


def _held_out(figure: Figure, found: Identification, details: Details) -> None:
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2.2, 1.0])
    first, y, simulated, rms, _ = details.held_out
    t = found.sample_period * np.arange(first, first + len(simulated), dtype=float)
    curve(upper, t, y, HUES['y'], 'measured', width=2.2)
    curve(upper, t, simulated, HUES['u_d'], 'simulated', '--')
    figures.legend_above(upper)
    curve(lower, t, y - simulated, HUES['e'])
    figures.zero_line(lower)
    share = 1.0 - rms / max(float(np.nanstd(y)), 1e-300)
    label(upper, f'{share:.2%} of the motion is predicted', 'y')
    label(lower, '', 'difference', TIME_LABEL)


def _loop(figure: Figure, found: Identification, details: Details) -> None:
    newest = slice(-4000, None)  # samples that the curves over v show
    left, right = figure.subplots(1, 2)
    v, o = details.v[newest], details.observed
    curve(left, v, o.y[newest], HUES['y'], width=0.8)
    label(left, 'As measured', 'y', 'v')
    curve(right, v, v - o.p[newest] + found.c_r, HUES['u'], width=0.8)
    for name, value in (('c_r', found.c_r), ('c_l', found.c_l)):
        right.axhline(value, color=HUES[name], linewidth=4.0, alpha=0.5,
                      label=f'${name}$ = {value:.4g}')
    label(right, 'As found', 'v − u / m', 'v')
    figures.legend_above(right)


def _residual(figure: Figure, found: Identification, details: Details) -> None:
    grid = figure.add_gridspec(2, 2)
    over_time = figure.add_subplot(grid[0, :])
    correlated, over_v = figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1])
    residual = details.observed.residual
    t = found.sample_period * (details.first + np.arange(len(residual), dtype=float))
    curve(over_time, t, residual, HUES['e'], width=0.8)
    label(over_time, f'Deviation {found.model.noise_std:.3g}', 'residual', TIME_LABEL)
    bound = BAND_STDS / np.sqrt(np.isfinite(residual).sum())
    r = autocorrelation(residual, 60)[1:]
    correlated.axhspan(-bound, bound, color='#bbbbbb', alpha=0.5, linewidth=0)
    correlated.vlines(np.arange(1, len(r) + 1), 0.0, r, color=HUES['e'], linewidth=1.5)
    correlated.set_ylim(*figures.limits([np.append(r, [-3.0 * bound, 3.0 * bound])], 0.1))
    label(correlated, 'Autocorrelation', '', 'lag [samples]')
    over_v.plot(details.v, residual, '.', color=HUES['e'], markersize=2, alpha=0.4,
                rasterized=True)
    label(over_v, 'Over v', '', 'v')
    for axes in (over_time, correlated, over_v):
        figures.zero_line(axes)


def _bode(figure: Figure, found: Identification, details: Details) -> None:
    magnitude, phase = figure.subplots(2, 1, sharex=True)
    w = np.geomspace(max(found.model.frequencies[0] / 5.0, 1e-5), 0.98 * np.pi, 400)
    value = details.response.at(w) * np.exp(-1j * w * found.model.delay)
    spread = BAND_STDS * details.response.std(w)
    size, angle = np.abs(value), np.degrees(np.unwrap(np.angle(value)))
    turn = np.degrees(np.arcsin(np.minimum(spread, 1.0)))
    for axes, middle, low, high, name, unit in (
        (magnitude, size, size * np.maximum(1.0 - spread, 1e-3), size * (1.0 + spread),
         'Magnitude', '|m G| [y/v]'),
        (phase, angle, angle - turn, angle + turn, 'Phase', 'degrees'),
    ):
        f = w / (2.0 * np.pi * found.sample_period)
        figures.band(axes, f, low, high, HUES['m'])
        curve(axes, f, middle, HUES['m'])
        for edge in found.hertz[[0, -1]]:
            axes.axvline(edge, color='#444444', linestyle=':', linewidth=1.0)
        label(axes, name, unit)
    label(phase, x='frequency [Hz]')
    magnitude.set(xscale='log', yscale='log', ylim=(size.min() / 3.0, size.max() * 3.0))
