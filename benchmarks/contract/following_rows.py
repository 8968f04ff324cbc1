"""Rows of `structure: tracking`: how well y follows y_m beside loops that know, and how calm v is.

Errors are those of y before the sensor, against y_m as late as the preview. Three loops are equal
but for: adaptive, nothing known of the backlash; without backlash, gap 0 and slope known;
uncompensated, slope known and gap taken as 0.
"""

from collections.abc import Mapping, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from cases.loops import NINE_DIGITS, loop_on, motor, without_sensor
from cases.random_cases import random_case

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.simulation.metrics import gap_crossings_per_reversal
from contract.figures import Array, Figure, by_group, figure, rms, share, upper

Changes = dict[str, Any]

SETTLED_S = 2.0  # from here on a loop counts as settled
PERIOD_S = 0.01  # of the paper's example
NO_GAP = {'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9, 'backlash.initial_u': 0.0}
CANCELLED = 0.1  # share of what the backlash costs that may be left


class Case(NamedTuple):
    """One reference. samples: of the run; y_m: of a reference that is no waveform."""

    group: str
    changes: Changes
    samples: int
    y_m: tuple[float, ...] = ()


class Followed(NamedTuple):
    """A case. Errors, RMS from the settled time on over that of the reference: adaptive, without
    backlash, uncompensated. crossings: of the gap for each reversal of y_m. moves: share of the
    last quarter in which v moves. peak: largest |y| over that of the uncompensated loop.
    """

    group: str
    adaptive: float
    gapless: float
    plain: float
    crossings: float | None
    moves: float
    peak: float

    @property
    def cancelled(self) -> bool:
        """Whether no more than a tenth of what the backlash costs is left, or it costs nothing."""
        left, cost = self.adaptive - self.gapless, self.plain - self.gapless
        return left <= max(CANCELLED * cost, 0.02 * self.gapless)


def following_jobs(scale: float) -> list[Case]:
    """The paper's plant with several references, with and without noise; and random plants."""
    cases = []
    t = PERIOD_S * np.arange(900)
    for seed in range(1, 1 + max(round(5 * scale), 1)):
        paper: Changes = {'structure': 'tracking', 'amplitude': 0.2, 'seed': seed,
                          'output_noise_std': 1e-3 if seed > 1 else 0.0}
        cases += [
            *(Case('sine', {**paper, 'amplitude': a}, 800) for a in (0.2, 1.0, 10.0)),
            Case('steps', {**paper, 'waveform': 'square', 'frequency': pi}, 1000),
            Case('triangle', {**paper, 'waveform': 'triangle', 'frequency': 2.0 * pi}, 1000),
            Case('chirp', {**paper, 'waveform': 'chirp', 'frequency_start': 0.2 * pi,
                           'frequency': 6.0 * pi}, 1200),
            Case('limits', {**paper, 'waveform': 'square', 'frequency': pi, 'control.min': -12.0,
                            'control.max': 12.0, 'control.rate_max': 150.0}, 1200),
            Case('rest', paper, 900, tuple(0.2 * np.sin(12.6 * np.minimum(t, 4.0)))),
            Case('slow sine, noise on y_m', {**motor(), 'structure': 'tracking', 'seed': seed},
                 6000, tuple(0.5 * np.sin(0.0025 * np.arange(6000))
                             + 1e-4 * np.random.default_rng(seed).standard_normal(6000))),
        ]
    for case in map(random_case, range(round(40 * scale))):
        p = case.parameters
        z = np.exp(1j * p.frequency * p.sample_period)
        gain = abs(np.polyval(p.plant.numerator, z) / np.polyval(p.plant.denominator, z))
        # A reference of the estimation for y.
        cases.append(Case('random', {**p, 'structure': 'tracking',
                                     'amplitude': float(gain) * p.amplitude},
                          p.tracking.preview + 8 * case.samples // 3))
    return cases


def run_following(case: Case) -> Followed:
    known = {'estimator.law': 'fixed', 'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
             'estimator.initial.m': Parameters(case.changes).backlash.m}
    try:
        (adaptive, run, y), (gapless, _, _), (plain, _, y_plain) = (
            _run(case, change) for change in (
                {}, {**known, **NO_GAP, 'fixed.doubt': 0.0}, {**known, 'fixed.doubt': 0.5}))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return Followed(case.group, 1e3, 1.0, 1.0, None, 1.0, 1e3)
    v = run.column('v')
    return Followed(
        case.group, adaptive, gapless, plain, gap_crossings_per_reversal(run, SETTLED_S),
        float(np.mean(np.diff(v[len(v) * 3 // 4:]) != 0.0)),
        float(np.abs(y).max() / np.abs(y_plain).max()),
    )


def _run(case: Case, change: Mapping[str, Any]) -> tuple[float, Any, Array]:
    """Error, run, y before the sensor."""
    values = {**case.changes, **change}
    p = Parameters(values)
    loop = loop_on(values, case.y_m, NINE_DIGITS) if case.y_m else build_closed_loop(p)
    with np.errstate(over='ignore', invalid='ignore'):
        run = loop.run(case.samples)
    y, delay = without_sensor(p, run), p.tracking.preview
    begin = min(max(round(SETTLED_S / p.sample_period), delay), case.samples // 2)
    wanted = run.column('y_m')[begin - delay:case.samples - delay]
    return min(rms(y[begin:] - wanted) / max(rms(wanted), 1e-12), 1e3), run, y


def following_figures(found: Sequence[Followed]) -> dict[str, Figure]:
    def of_group(of: Sequence[Followed]) -> dict[str, Figure]:
        over_gapless = [min(f.adaptive / max(f.gapless, 1e-12), 1e3) for f in of]
        return {
            'error / without backlash, median': figure(over_gapless),
            'error / without backlash, 90 %': figure(over_gapless, upper),
            'a tenth of the cost left, or less': share([f.cancelled for f in of], 'more'),
            'crossings of the gap for each reversal': figure([f.crossings for f in of]),
            'largest |y| / uncompensated': figure([f.peak for f in of]),
            **({'share of samples in which v moves': share([f.moves for f in of])}
               if of[0].group == 'rest' else {}),
        }

    return by_group(found, of_group)
