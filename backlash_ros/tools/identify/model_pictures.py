"""Pictures of the G(z) that was found, with how well it is known: poles, zeros, Bode plot."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.ticker import NullFormatter
from numpy.typing import NDArray

from backlash_ros.core.identification.identification import Details, Identification
from backlash_ros.core.identification.uncertainty import response, response_std, root_covariances
from backlash_ros.tools.figures import HUES, label, legend_above

Array = NDArray[np.float64]

SURE = 2.0  # standard deviations that bands and ellipses reach


def new_figure(height: float) -> Figure:
    """Figure with margins that suit all of identify.html: a layout takes as long as to draw it."""
    figure = Figure(figsize=(10.0, height), constrained_layout=False)
    figure.subplots_adjust(
        left=0.085, right=0.985, bottom=0.55 / height, top=1.0 - 0.4 / height, wspace=0.2,
        hspace=0.4,
    )
    return figure


def draw_poles(found: Identification, details: Details) -> Figure:
    """Poles and zeros in the plane of z, whole and near 1."""
    fit, covariance = details.fit, details.covariance
    figure = new_figure(5.2)
    rooms = figure.subplots(1, 2)
    count = covariance.poles
    a_cov = np.zeros((count + 1, count + 1))
    a_cov[1:, 1:] = covariance.matrix[:count, :count]
    poles, pole_spreads = root_covariances(np.append(1.0, fit.point.a), a_cov)
    if found.integrator:
        poles = np.append(poles, 1.0)
        pole_spreads = np.concatenate([pole_spreads, np.zeros((1, 2, 2))])
    of_b = covariance.numerator
    zeros, zero_spreads = root_covariances(fit.numerator, covariance.matrix[of_b, of_b])
    span = max([0.02, *(1.3 * np.abs(poles - 1.0)).tolist()])
    for axes, near in zip(rooms, (False, True), strict=True):
        circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 720))
        axes.plot(circle.real, circle.imag, color='#777777', linewidth=0.8)
        for roots, spreads, mark, colour, name in (
            (poles, pole_spreads, 'x', HUES['c_r'], 'poles'),
            (zeros, zero_spreads, 'o', HUES['m'], 'zeros'),
        ):
            axes.plot(roots.real, roots.imag, mark, color=colour, markerfacecolor='none',
                      markersize=8, label=name)
            for root, spread in zip(roots, spreads, strict=True):
                _ellipse(axes, root, spread, colour)
        axes.set_aspect('equal')
        reach = 1.25 if not near else min(span, 1.25)
        centre = 1.0 if near else 0.0
        axes.set_xlim(centre - reach, centre + (0.35 * reach if near else reach))
        axes.set_ylim(-0.7 * reach if near else -reach, 0.7 * reach if near else reach)
        label(axes, 'Near 1' if near else 'Plane of z', 'imaginary part', 'real part')
    outside = [zero for zero in zeros if abs(zero) > 1.25]
    if outside:
        text = ', '.join(
            f'{z.real:.3g}' if abs(z.imag) < 1e-9 else f'{z:.3g}' for z in outside
        )
        rooms[0].set_xlabel(f'real part (outside of the picture: zeros at {text})')
    legend_above(rooms[1])
    return figure


def _ellipse(axes: Axes, root: complex, spread: Array, colour: str) -> None:
    if not np.isfinite(spread).all():
        return
    sizes, directions = np.linalg.eigh(0.5 * (spread + spread.T))
    width, height = 2.0 * SURE * np.sqrt(np.maximum(sizes, 0.0))
    angle = float(np.degrees(np.arctan2(directions[1, 0], directions[0, 0])))
    axes.add_patch(Ellipse(
        (root.real, root.imag), width, height, angle=angle, facecolor=colour, alpha=0.2,
        edgecolor=colour,
    ))


def draw_bode(found: Identification, details: Details) -> Figure:
    """Magnitude and phase of m G, its delay included."""
    figure = new_figure(5.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    low = max(found.frequencies[0] / 5.0, 1e-5)
    w = np.geomspace(low, 0.98 * np.pi, 400)
    value = response(details.fit, w) * np.exp(-1j * w * found.delay)
    spread = SURE * response_std(details.fit, details.covariance, w)
    hertz = w / (2.0 * np.pi * found.sample_period)
    size = np.abs(value)
    upper.fill_between(hertz, size * np.maximum(1.0 - spread, 1e-3), size * (1.0 + spread),
                       color=HUES['m'], alpha=0.25, linewidth=0)
    upper.loglog(hertz, size, color=HUES['m'])
    phase = np.degrees(np.unwrap(np.angle(value)))
    turn = np.degrees(np.arcsin(np.minimum(spread, 1.0)))
    lower.fill_between(hertz, phase - turn, phase + turn, color=HUES['m'], alpha=0.25,
                       linewidth=0)
    lower.semilogx(hertz, phase, color=HUES['m'])
    for axes in (upper, lower):
        for edge in (found.frequencies[0], found.frequencies[-1]):
            axes.axvline(edge / (2.0 * np.pi * found.sample_period), color='#444444',
                         linestyle=':', linewidth=1.0)
    label(upper, 'Magnitude', '|m G| [y/v]')
    label(lower, 'Phase', 'degrees', 'frequency [Hz]')
    for axis in (upper.xaxis, upper.yaxis, lower.xaxis):
        axis.set_minor_formatter(NullFormatter())
    upper.set_ylim(float(size.min()) / 3.0, float(size.max()) * 3.0)
    return figure
