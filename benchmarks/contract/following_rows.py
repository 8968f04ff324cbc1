"""Rows of `structure: tracking`: how y follows y_m, how calm v is, how often it crosses the gap.

Errors are those of y before the sensor, against y_m as late as the preview. Three loops are equal
but for: adaptive, nothing known of the backlash; without backlash, gap 0 and slope known;
uncompensated, slope known and gap taken as 0. A crossing costs wear and noise: allowed are one for
each turn of u* in a loop without backlash and noise, one at the start, and one more in 10 s.
"""

from collections.abc import Mapping, Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from cases.loops import NINE_DIGITS, load_model, loop_on, motor, without_sensor
from cases.random_cases import random_case
from contract.figures import Array, Figure, by_group, figure, rms, share, upper
from scipy.signal import cont2discrete, sawtooth

from backlash_ros.core import Parameters, Status, build_closed_loop
from backlash_ros.core.assembly import build_model
from backlash_ros.core.plant.simulated_plant import altered_plant
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.run_record import RunRecord, gap_crossings_per_reversal, turns

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


LONGEST_S, MOST_SAMPLES = 40.0, 5000
LEAST_TURN = 0.01  # share of m gap by which u* turns at least
PLANTS = ('motor', 'paper', 'integrator')
MOTIONS = ('sine', 'triangle', 'steps', 'moves', 'sines')
CONSTANTS = ('exact', '3 % off', 'learned')


class Crossing(NamedTuple):
    """One loop: crossings of the gap by v over those allowed, and RMS of y - y_m over that of a
    loop without backlash in the same noise.
    """

    group: str
    crossings: float
    error: float


def crossings_jobs(scale: float, first_seed: int = 0) -> list[int]:
    return list(range(first_seed, first_seed + max(round(48 * scale), 24)))


def moves_with_rests(
    rng: np.random.Generator, period_s: float, omega: float, end_s: float,
) -> Array:
    """Smooth moves of about half a period at omega [rad/s], between places within +-1."""
    places = [np.zeros(round(0.5 / period_s))]
    while sum(map(len, places)) * period_s < end_s:
        at, to = float(places[-1][-1]), float(rng.uniform(-1.0, 1.0))
        s = np.linspace(0.0, 1.0, max(round(rng.uniform(0.5, 1.5) * pi / omega / period_s), 8))
        rest_s = rng.uniform(0.3, 4.0)
        places += [at + (to - at) * s * s * (3.0 - 2.0 * s), np.full(round(rest_s / period_s), to)]
    return np.concatenate(places)


def case_of(seed: int) -> tuple[dict[str, Any], Array, Array, tuple[str, str]]:
    """Parameters, the reference, as it is heard, the motion and what is known of the constants."""
    rng = np.random.default_rng([seed, 37])
    plant, motion = PLANTS[seed % 3], MOTIONS[seed // 3 % 5]
    constants = CONSTANTS[seed // 15 % 3]
    period_s = float(1.0 / np.exp(rng.uniform(np.log(50.0), np.log(1000.0))))
    omega = float(np.exp(rng.uniform(np.log(0.4), np.log(10.0))))
    if plant == 'integrator':
        b, a, _ = cont2discrete(([20.0], [1.0, 20.0, 0.0]), period_s)
        model = TransferFunction(b[0, 1:], a)
    else:
        model = TransferFunction(*load_model(period_s)) if plant == 'motor' \
            else altered_plant(build_model(Parameters({})), period_s / 0.01)
    values: dict[str, Any] = {
        **(motor() if plant == 'motor' else {}), 'sample_period': period_s,
        'plant.numerator': model.numerator.tolist()[1:],
        'plant.denominator': model.denominator.tolist(), 'structure': 'tracking',
        'seed': seed, 'amplitude': 1.0, 'bias': 0.0}
    hidden = Parameters(values).backlash
    gain = float(abs(model.response(np.array([np.exp(1j * omega * period_s)]))[0]))
    of_gap = gain * hidden.m * (hidden.c_r - hidden.c_l)
    amplitude = of_gap * float(np.exp(rng.uniform(np.log(0.7), np.log(8.0))))
    amplitude = min(amplitude, 0.7 if plant == 'motor' else np.inf)
    noise = (0.0, 1e-3, 1e-2, 0.1)[int(rng.integers(4))] * float(rng.uniform(0.5, 1.0)) * of_gap
    wrongly_told = bool(rng.random() < 0.25)
    heard_noise = (0.0, 2e-4)[int(rng.integers(2))] * amplitude
    told = max(noise / (10.0 if wrongly_told else 1.0), 1e-4 * of_gap)
    values |= {'output_noise_std': noise, 'estimator.output_noise_std': told}
    if constants != 'learned':
        off = 1.03 if constants == '3 % off' else 1.0
        values |= {'estimator.law': 'fixed', 'estimator.initial.m': hidden.m / off,
                   'estimator.initial.c_r': off * hidden.c_r,
                   'estimator.initial.c_l': off * hidden.c_l}
    count = round(min(LONGEST_S, max(12.0, 5.3 * 2.0 * pi / omega)) / period_s)
    t = period_s * np.arange(min(count, MOST_SAMPLES))
    wanted = amplitude * {
        'sine': lambda: np.sin(omega * t), 'triangle': lambda: sawtooth(omega * t + 0.5 * pi, 0.5),
        'steps': lambda: np.sign(np.sin(omega * t + 1e-9)),
        'moves': lambda: moves_with_rests(rng, period_s, omega, float(t[-1]) + period_s)[:len(t)],
        'sines': lambda: sum(np.sin(omega * f * t) for f in (0.37, 1.0, 1.71)) / 3.0,
    }[motion]()
    heard = wanted + heard_noise * rng.standard_normal(len(t))
    return values, wanted, heard, (motion, constants)


def run_crossings(seed: int) -> Crossing:
    """The loop, and those without backlash."""
    values, wanted, heard, (motion, constants) = case_of(seed)
    p = Parameters(values)
    gapless = {**values, 'estimator.law': 'fixed', 'fixed.doubt': 0.0,
               'estimator.initial.m': p.backlash.m,
               'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
               'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9, 'backlash.initial_u': 0.0}
    ideal = loop_on({**gapless, 'output_noise_std': 0.0, 'output_quantum': 0.0}, wanted) \
        .run(len(wanted)).column('u_d')
    loop = loop_on(values, heard)
    run, beside = loop.run(len(heard)), loop_on(gapless, heard).run(len(heard))
    begin = delay = loop.controller.structure.delay
    count = len(wanted)
    if constants == 'learned':
        known = np.flatnonzero(run.column('status') == int(Status.TRACKING))
        begin += (known[0] if len(known) else count // 2) + 100
    begin = min(begin, 3 * count // 4)
    gap = float(run.column('true_c_r')[0] - run.column('true_c_l')[0])
    allowed = (turns(ideal[begin:], LEAST_TURN * p.backlash.m * gap) + 1.0
               + (count - begin) * run.sample_period / 10.0)

    def error(of: RunRecord) -> float:
        return rms(without_sensor(p, of)[begin:] - wanted[begin - delay:count - delay])

    return Crossing(motion, turns(run.column('v')[begin:], 0.5 * gap) / allowed,
                    error(run) / error(beside))


def crossings_figures(found: Sequence[Crossing]) -> dict[str, Figure]:
    return by_group(found, lambda of: {
        'more crossings than allowed': share([one.crossings > 1.0 for one in of]),
        'crossings / allowed, median': figure([one.crossings for one in of]),
        'crossings / allowed, 90 %': figure([one.crossings for one in of], upper),
        'error / without backlash, median': figure([one.error for one in of]),
    })
