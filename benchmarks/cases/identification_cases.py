"""Random actuators, motions and noises for the benchmark of the identification."""

from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import Array
from scipy.signal import cont2discrete, lfilter

from backlash_ros.core.control.motion import strokes
from backlash_ros.core.plant.backlash import play

SECONDS = 10.0
PERIODS_S = (0.004, 0.005, 0.01)
INTEGRATING = 0.35  # share of the cases
SETTLING = 400  # samples before the record, in which u is held
GAPS = (0.02, 0.4)  # of the swing of v
NOISE = (5e-4, 1e-2)  # of the swing of y, without its drift: deviation, or step of an encoder


class Case(NamedTuple):
    """One case. numerator, denominator: of m G without the delay. y: with noise or rounded."""

    period: float
    numerator: Array
    denominator: Array
    delay: int
    integrating: bool
    m: float
    gap: float
    c_r: float
    c_l: float
    v: Array
    y: Array
    level: float  # of the noise [y]

    def response(self, frequencies: Array) -> NDArray[np.complex128]:
        """m G with its delay, at frequencies [rad/sample]."""
        z = np.exp(1j * frequencies)
        value = np.polyval(self.numerator, z) / np.polyval(self.denominator, z)
        return np.asarray(value * z ** -float(self.delay))


def random_case(seed: int, series: int = 2026) -> Case:
    """An actuator of order 1 to 4 and 10 s of its motion."""
    rng = np.random.default_rng([series, seed])
    period = float(rng.choice(PERIODS_S))
    count = round(SECONDS / period)
    order, integrating = int(rng.integers(1, 5)), bool(rng.random() < INTEGRATING)
    delay = int(rng.integers(0, 3))
    numerator, denominator = _plant(rng, order, integrating, period)
    m, reach = (float(np.exp(rng.uniform(*ends))) for ends in ((-1.0, 1.0), (-1.0, 2.0)))
    v = (_driven if rng.random() < 0.5 else _multisine)(rng, reach, period, count)
    gap = _geometric(rng, *GAPS) * float(np.ptp(v))
    c_r = gap * float(rng.uniform(0.2, 0.8))
    start = float(v[0]) + float(rng.uniform(0.0, 1.0)) * gap
    u = m * (play(v, gap, start) - c_r)
    before = np.full(SETTLING + delay + 1, 0.0 if integrating else u[0])
    clean = lfilter(numerator, denominator, np.append(before, u))[SETTLING:SETTLING + count]
    k = np.arange(count)
    moving = clean - np.polyval(np.polyfit(k, clean, 1), k) if integrating else clean
    level = _geometric(rng, *NOISE) * float(np.ptp(moving))
    y = np.round(clean / level) * level if rng.random() < 0.5 \
        else clean + level * rng.standard_normal(count)
    return Case(period, m * numerator, denominator, delay, integrating, m, gap, c_r, c_r - gap,
                v, y, level)


def _geometric(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _plant(
    rng: np.random.Generator, order: int, integrating: bool, period: float,
) -> tuple[Array, Array]:
    """B, A with a gain of 1 at rest (of the velocity, where it integrates)."""
    poles: list[complex] = [0.0] if integrating else []
    while len(poles) < order:
        if order - len(poles) >= 2 and rng.random() < 0.5:
            w, damping = 2.0 * np.pi * _geometric(rng, 1.0, 10.0), rng.uniform(0.2, 0.9)
            pole = w * complex(-damping, np.sqrt(1.0 - damping**2))
            poles += [pole, pole.conjugate()]
        else:
            poles.append(-2.0 * np.pi * _geometric(rng, 0.5, 8.0))
    numerator = np.ones(1)
    if order >= 2 and rng.random() < 0.5:
        zero = 2.0 * np.pi * _geometric(rng, 1.0, 10.0) * (1.0 if rng.random() < 0.6 else -1.0)
        numerator = np.array([-1.0 / zero, 1.0])
    denominator = np.real(np.poly(poles))
    gain = denominator[-2] if integrating else denominator[-1]
    b, a, _ = cont2discrete((gain * numerator, denominator), period, 'zoh')
    return b.ravel()[1:], a


def _driven(rng: np.random.Generator, reach: float, period: float, count: int) -> Array:
    """The motion of `identify --drive`, with a limit of the speed from slow to fast."""
    rate = 2.0 * reach * _geometric(rng, 3.0, 20.0)
    return np.array(list(islice(strokes(-reach, reach, rate, period, SECONDS, 0.0), count)))


def _multisine(rng: np.random.Generator, reach: float, period: float, count: int) -> Array:
    """What a user might have recorded: four sines."""
    t = period * np.arange(count)
    first, phases = rng.uniform(0.4, 1.2), rng.uniform(0.0, 2.0 * np.pi, 4)
    v = sum(size * np.sin(2.0 * np.pi * first * harmonic * t + phase) for size, harmonic, phase
            in zip((1.0, 0.6, 0.4, 0.25), (1.0, 2.3, 3.7, 5.9), phases, strict=True))
    return np.asarray(reach * v / np.abs(v).max())


NO_PLAYS = ('no play', 'dead zone', 'saturation', 'many plays', 'pushed')


def without_play(kind: str, seed: int) -> tuple[Array, Array, Array]:
    """t, v, y (N,) of what looks like a play, and is none, or not that alone."""
    rng = np.random.default_rng([seed, len(kind)])
    period, count = 0.01, 2000
    v = _multisine(rng, 1.0, period, count)
    if kind == 'pushed':  # v in steps, with rests in which something else moves the load
        v = np.repeat(np.round(v[::100], 1), 100)
    size = float(rng.uniform(0.1, 0.3))
    u = {
        'dead zone': lambda: np.sign(v) * np.maximum(np.abs(v) - size, 0.0),
        'saturation': lambda: np.clip(play(v, 0.3 * size, 0.0), -2.0 * size, 2.0 * size),
        'many plays': lambda: np.mean([play(v, g, 0.0) for g in np.linspace(0, 3 * size, 12)], 0),
    }.get(kind, lambda: v)()
    a = float(rng.uniform(0.6, 0.9))
    y = lfilter([0.0, 1.0 - a], [1.0, -a], u)
    if kind == 'pushed':
        y = y + 0.3 * size * np.sin(0.07 * np.arange(count)) * (np.arange(count) % 400 > 200)
    return period * np.arange(count), v, y + 2e-3 * rng.standard_normal(count)
