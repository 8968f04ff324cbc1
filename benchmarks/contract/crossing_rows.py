"""Row of `structure: tracking`: how often v crosses the gap beside turns of the ideal trajectory.

A crossing costs wear and noise. Allowed are one for each turn of u* in a loop without backlash and
noise, one at the start, and one more in 10 s. Random cases: geared motor and the paper's plant at
50 to 1,000 Hz; sine, triangle, steps, and moves with rests; noise on y up to a tenth of the gap,
known or ten times what was told; noise on y_m; constants exact, 3 % off, or learned.
"""

from collections.abc import Sequence
from math import pi
from typing import Any, NamedTuple

import numpy as np
from cases.loops import load_model, loop_on, motor, without_sensor
from scipy.signal import sawtooth

from backlash_ros.core import Parameters, Status
from backlash_ros.core.assembly import build_model
from backlash_ros.core.plant.simulated_plant import altered_plant
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.metrics import turns
from backlash_ros.core.simulation.run_record import RunRecord
from contract.figures import Array, Figure, by_group, figure, rms, share, upper

LONGEST_S, MOST_SAMPLES = 40.0, 5000
LEAST_TURN = 0.01  # share of m gap by which u* turns at least
MOTIONS = ('sine', 'triangle', 'steps', 'moves')
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
    plant, motion = ('motor', 'paper')[seed % 2], MOTIONS[seed // 2 % 4]
    constants = CONSTANTS[seed // 8 % 3]
    period_s = float(1.0 / np.exp(rng.uniform(np.log(50.0), np.log(1000.0))))
    omega = float(np.exp(rng.uniform(np.log(0.4), np.log(10.0))))
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
