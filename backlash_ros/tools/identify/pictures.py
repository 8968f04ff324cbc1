"""The pictures of identify.html: a person judges by them whether the result is to be trusted."""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.identification.model import autocorrelation
from backlash_ros.tools import figures
from backlash_ros.tools.figures import HUES, curve, draw_panels, label
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
            figure = figures.new_figure(height, constrained_layout=False)
            # Margins that suit all of them: a layout takes as long as to draw it.
            figure.subplots_adjust(left=0.1, right=0.985, bottom=0.55 / height,
                                   top=1.0 - 0.4 / height, wspace=0.2, hspace=0.4)
            draw(figure, found, found.details)
            yield Picture(name, heading, caption, figures.png(figure))


def _held_out(figure: Figure, found: Identification, details: Details) -> None:
    first, y, simulated, rms, _ = details.held_out
    t = found.sample_period * np.arange(first, first + len(simulated), dtype=float)
    upper, lower = draw_panels(figure, {
        'y': [(t, y, HUES['y'], 'measured', '-', 2.2),
              (t, simulated, HUES['u_d'], 'simulated', '--')],
        'difference': [(t, y - simulated, HUES['e'])],
    }, height_ratios=[2.2, 1.0])[:, 0]
    label(upper, f'{1.0 - rms / max(float(np.nanstd(y)), 1e-300):.2%} of the motion is predicted')
    figures.legend_above(upper)
    figures.zero_line(lower)


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
    over_time, correlated, over_v = figure.subplot_mosaic('tt;cv').values()
    residual = details.observed.residual
    t = found.sample_period * (details.first + np.arange(len(residual), dtype=float))
    curve(over_time, t, residual, HUES['e'], width=0.8)
    label(over_time, f'Deviation {found.model.noise_std:.3g}', 'residual', figures.TIME_LABEL)
    bound = BAND_STDS / np.sqrt(np.isfinite(residual).sum())
    r = autocorrelation(residual, 60)[1:]
    correlated.axhspan(-bound, bound, color='#bbbbbb', alpha=0.5, linewidth=0)
    correlated.vlines(np.arange(1, len(r) + 1), 0.0, r, color=HUES['e'], linewidth=1.5)
    correlated.set_ylim(*figures.limits([np.append(r, [-3.0 * bound, 3.0 * bound])], 0.1))
    label(correlated, 'Autocorrelation', x='lag [samples]')
    over_v.plot(details.v, residual, '.', color=HUES['e'], markersize=2, alpha=0.4,
                rasterized=True)
    label(over_v, 'Over v', x='v')
    for axes in (over_time, correlated, over_v):
        figures.zero_line(axes)


def _bode(figure: Figure, found: Identification, details: Details) -> None:
    w = np.geomspace(max(found.model.frequencies[0] / 5.0, 1e-5), 0.98 * np.pi, 400)
    f = w / (2.0 * np.pi * found.sample_period)
    value = details.response.at(w) * np.exp(-1j * w * found.model.delay)
    spread = BAND_STDS * details.response.std(w)
    size, angle = np.abs(value), np.degrees(np.unwrap(np.angle(value)))
    turn = np.degrees(np.arcsin(np.minimum(spread, 1.0)))
    magnitude, phase = draw_panels(figure, {
        '|m G| [y/v]': [(f, size, HUES['m'])], 'degrees': [(f, angle, HUES['m'])]})[:, 0]
    figures.band(magnitude, f, size * np.maximum(1.0 - spread, 1e-3), size * (1.0 + spread),
                 HUES['m'])
    figures.band(phase, f, angle - turn, angle + turn, HUES['m'])
    for edge in found.hertz[[0, -1]]:
        for axes in (magnitude, phase):
            axes.axvline(edge, color='#444444', linestyle=':', linewidth=1.0)
    label(magnitude, 'Magnitude')
    label(phase, 'Phase', x='frequency [Hz]')
    magnitude.set(xscale='log', yscale='log', ylim=(size.min() / 3.0, size.max() * 3.0))
