"""Random plants, gaps and references, and the Cramér–Rao bound for the v that was applied."""

from collections.abc import Callable
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import Array
from scipy import linalg, signal
from scipy.signal import lfilter

from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.assembly import build_true_model

SINGULAR = 1e-13  # of the largest singular value: a direction that y does not show


def engaged_regressors(v: Array, m: float, c_r: float, c_l: float, u: float) -> Array:
    """phi(k) of u(k) = phi' (m, m c_r, m c_l, u_0), shape (N, 4); u is held at first."""
    rows = np.zeros((len(v), 4))
    row = np.array([0.0, 0.0, 0.0, 1.0])
    for k, value in enumerate(v):
        if u <= m * (value - c_r):
            u, row = m * (value - c_r), np.array([value, -1.0, 0.0, 0.0])
        elif u >= m * (value - c_l):
            u, row = m * (value - c_l), np.array([value, 0.0, -1.0, 0.0])
        rows[k] = row
    return rows


def cramer_rao(
    v: Array, numerator: Array, denominator: Array, truth: tuple[float, float, float],
    noise_std: float, received: NDArray[np.bool_] | None = None, u0: float = 0.0,
    effects: Callable[[Array], Array] | None = None,
) -> Array:
    """Smallest standard deviations of (m, c_r, c_l) from y(0..N), v(0..N-1) applied, shape (3,).

    received: which of y(0..N) arrived. Unknown are x(0), theta and the u held at the start.
    effects: what a standard deviation of each of K other unknowns does to y, shape (N+1, K), from
    u(0..N); these are known beforehand to be normal around their true values (Van Trees).
    inf where y does not show a parameter.
    """
    m, c_r, c_l = truth
    phi = np.vstack([engaged_regressors(v, m, c_r, c_l, u0), np.zeros((1, 4))])
    b = np.concatenate([np.zeros(len(denominator) - len(numerator)), numerator])
    forced = [signal.lfilter(b, denominator, phi[:, i]) for i in range(4)]
    impulses = np.eye(len(denominator) - 1, len(phi))
    free = [signal.lfilter(np.ones(1), denominator, impulse) for impulse in impulses]
    held = [forced[3]] if np.any(forced[3]) else []
    sensitivity = np.column_stack([*forced[:3], *free, *held])
    if effects is not None:
        sensitivity = np.hstack([sensitivity, effects(phi @ [m, m * c_r, m * c_l, u0])])
    if received is not None:
        sensitivity = sensitivity[received]
    if effects is not None:
        prior = noise_std * np.eye(sensitivity.shape[1])[3 + len(free) + len(held):]
        sensitivity = np.vstack([sensitivity, prior])
    jacobian = np.array([[1.0, 0, 0], [-c_r / m, 1 / m, 0], [-c_l / m, 0, 1 / m]])
    root, hidden = _theta_root(sensitivity)
    # Each column of root is one direction of the data: the norms are standard deviations.
    bound = noise_std * np.linalg.norm(jacobian @ root, axis=1)
    bound[np.abs(jacobian) @ hidden > 0.0] = np.inf
    return np.asarray(bound)


def _theta_root(sensitivity: Array) -> tuple[Array, Array]:
    """Return L with L L' = the first 3 x 3 block of the inverse information for unit noise.

    The second value says how much of each theta lies in directions that y does not show.
    """
    size = np.linalg.norm(sensitivity, axis=0)
    size[size == 0.0] = 1.0
    r = linalg.qr(sensitivity / size, mode='r')[0][: len(size)]
    _, singular, rows = linalg.svd(r)
    lost = singular <= SINGULAR * singular[0]
    root = rows[~lost, :3].T / singular[~lost] / size[:3, None]
    hidden = np.abs(rows[lost, :3]).max(axis=0, initial=0.0)
    hidden[hidden < np.sqrt(SINGULAR)] = 0.0
    return np.asarray(root), np.asarray(hidden)


PERIODS = 3
NOISE_TO_SWING = 0.002  # noise on y over its swing, at most
TOLD = 0.004  # relative Cramér-Rao bound of the loop that knows the backlash, at most
TOLD_UNCERTAIN = 0.006  # the same where G is off, and more error is allowed
SPREAD = 0.1  # by which each time constant is off, up or down, where G is
UNCERTAINTY = 0.2  # that is told then
STEP = 1e-3  # of the logarithm of a time constant, for a derivative
ITERATIONS, CLOSER = 50, 0.99  # to the noise of a bound
DRAWS = 10  # two for every pole of a plant
NEAR_ONE = 1e-6  # distance of a pole from 1 that makes it an integrator


class Case(NamedTuple):
    """One random case: what the package is given, and three periods of the reference."""

    parameters: Parameters
    samples: int


def random_plant(rng: np.random.Generator) -> tuple[Array, Array]:
    """Numerator and denominator of a stable or integrating G of order 1 to 5."""
    order = int(rng.integers(1, 6))
    integrating = bool(rng.random() < 0.4)
    poles: list[complex] = [1.0] if integrating else []
    while len(poles) < order:
        if len(poles) + 2 <= order and rng.random() < 0.3:
            radius, angle = rng.uniform(0.6, 0.97), rng.uniform(0.05, 0.6)
            poles += [radius * np.exp(1j * angle), radius * np.exp(-1j * angle)]
        else:
            poles.append(float(np.exp(-np.exp(rng.uniform(np.log(0.01), np.log(0.5))))))
    zeros = [float(rng.choice([-1.0, 1.0]) * rng.uniform(1.15, 4.0)) if rng.random() < 0.4
             else float(rng.uniform(-0.9, 0.8)) for _ in range(int(rng.integers(0, order)))]
    numerator = np.atleast_1d(np.real(np.poly(zeros))) * 10.0 ** rng.uniform(-4.0, 0.0)
    return numerator, np.real(np.poly(poles))


def random_case(seed: int) -> Case:
    """The case of a seed.

    A case asks what the motion tells. Its noise is 0.2 % of the swing of y, or less where the
    Cramér-Rao bound of the loop that knows the backlash is beyond 0.4 % for m, c_r or c_l after the
    three periods, as for a small c_r beside a large c_l. No estimator has a part in that.
    """
    return _with_noise(_without_noise(seed), TOLD)


def uncertain_case(seed: int) -> Case:
    """The case of a seed with a plant that is another one than G, as `altered` says.

    The reference is slower than every pole, omega tau <= 1: to a faster one a time constant is a
    gain, which y does not tell from m. The bound that limits the noise is 0.6 %, for time constants
    and damping that are known as well as they are spread. Every time constant is off by SPREAD, the
    damping as it was.
    """
    case = _without_noise(seed, below_corners=True)
    p = case.parameters
    signs = np.random.default_rng([seed, 21]).choice([-1.0, 1.0], DRAWS // 2)
    off = np.column_stack([signs * np.log1p(SPREAD), np.zeros(DRAWS // 2)]).ravel()
    numerator, denominator = altered(
        np.array(p.plant.numerator), np.array(p.plant.denominator), off)
    p = p.replaced({
        'truth.numerator': numerator.tolist(), 'truth.denominator': denominator.tolist(),
        'plant.uncertainty': UNCERTAINTY,
    })
    return _with_noise(case._replace(parameters=p), TOLD_UNCERTAIN)


def _without_noise(seed: int, below_corners: bool = False) -> Case:
    """below_corners: whether the reference is no faster than the slowest pole."""
    rng = np.random.default_rng([seed, 20])
    numerator, denominator = random_plant(rng)
    m, c_r, c_l = (sign * float(np.exp(rng.uniform(np.log(low), np.log(high))))
                   for sign, low, high in ((1, 0.3, 3.0), (1, 0.2, 8.0), (-1, 0.2, 8.0)))
    factors = 10.0 ** rng.uniform(-1.0, 1.0, 3)
    first = (m * factors[0], c_r * factors[1], c_l * factors[2])
    samples_per_period = int(rng.integers(40, 200))
    if below_corners:
        samples_per_period = max(samples_per_period, ceil(2.0 * np.pi * _slowest(denominator)))
    period = 0.01
    omega = 2.0 * np.pi / (samples_per_period * period)
    waveform = str(rng.choice(['sine', 'multisine']))
    f = 0.22 * m if rng.random() < 0.5 else 0.0
    # Through (3.2) a first slope that is too large makes v small: y_m is chosen so that v swings
    # over 1.5 to 4 gaps with the true slope and with the first one.
    slope = max(m, first[0]) - min(f, 0.8 * min(m, first[0]))
    crest = 1.0 if waveform == 'sine' else 0.5
    amplitude = float(rng.uniform(1.5, 4.0)) * 0.5 * (c_r - c_l) * slope / crest
    parameters = Parameters({
        'plant.numerator': numerator.tolist(), 'plant.denominator': denominator.tolist(),
        'backlash.m': m, 'backlash.c_r': c_r, 'backlash.c_l': c_l,
        'backlash.initial_u': float(rng.uniform(-1.0, 1.0) * amplitude),
        'estimator.initial.m': first[0], 'estimator.initial.c_r': first[1],
        'estimator.initial.c_l': first[2], 'proportional.f': f,
        'waveform': waveform, 'amplitude': amplitude, 'frequency': float(omega),
        'sample_period': period, 'seed': seed, 'plant.uncertainty': 0.0,
    })
    return Case(parameters, PERIODS * samples_per_period)


def _slowest(denominator: Array) -> float:
    sizes = [abs(pole) for pole in np.roots(denominator) if abs(pole - 1.0) >= NEAR_ONE]
    return float(-1.0 / np.log(max(sizes))) if sizes else 0.0


def _with_noise(case: Case, told: float) -> Case:
    noise = _noise(case, told)
    return case._replace(parameters=case.parameters.replaced(
        {'output_noise_std': noise, 'estimator.output_noise_std': noise}))


def altered(numerator: Array, denominator: Array, logs: Array) -> tuple[Array, Array]:
    """G(z) with other time constants and damping; zeros, integrators and gain at rest stay.

    logs: logarithms of two factors for each pole, shape (2 n,) or longer: on its natural frequency
    and, in complex pairs, on its damping.
    """
    poles: list[complex] = []
    before = np.roots(denominator)
    factors = np.exp(logs).reshape(-1, 2)
    for pole, (frequency, damping) in zip(before, factors, strict=False):
        if abs(pole - 1.0) < NEAR_ONE:
            poles.append(1.0)
        elif pole.imag >= 0.0:
            rate = np.log(complex(pole)) * frequency
            if pole.imag == 0.0:
                poles.append(float(np.exp(rate.real)))
            else:
                ratio = -damping * rate.real / abs(rate)
                root = np.sqrt(complex(ratio**2 - 1.0))
                poles += np.exp(abs(rate) * np.array([root - ratio, -root - ratio])).tolist()
    gain = np.prod([1.0 - pole for pole in poles if pole != 1.0]) \
        / np.prod([1.0 - pole for pole in before if abs(pole - 1.0) >= NEAR_ONE])
    return np.real(gain) * numerator, np.asarray(np.real(np.poly(poles)))


def bound_of(p: Parameters, v: Array) -> Array:
    """Relative Cramér-Rao bounds of (m, c_r, c_l) for v (N,), with what is known of G; (3,)."""
    truth = p.backlash.m, p.backlash.c_r, p.backlash.c_l
    model = build_true_model(p)
    numerator, denominator = model.numerator, model.denominator

    def effects(u: Array) -> Array:
        steps = SPREAD * STEP * np.eye(2 * model.order)
        there, back = (
            np.array([_response(*altered(numerator, denominator, s), u) for s in sign * steps])
            for sign in (1.0, -1.0))
        return np.asarray((there - back).T / (2.0 * STEP))

    bound = cramer_rao(
        v, numerator, denominator, truth, p.output_noise_std, u0=p.backlash.initial_u,
        effects=effects if p.plant.uncertainty else None,
    )
    return np.asarray(bound / np.abs(truth))


def _response(numerator: Array, denominator: Array, u: Array) -> Array:
    delayed = np.concatenate([np.zeros(len(denominator) - len(numerator)), numerator])
    return np.asarray(lfilter(delayed, denominator, u))


def _noise(case: Case, told: float) -> float:
    """Deviation of the noise on y, from the loop that knows the backlash, without noise.

    told: bound that the noise may lead to.
    """
    p = case.parameters
    known = p.replaced({
        'estimator.law': 'fixed', 'plant.uncertainty': 0.0,
        **{f'estimator.initial.{name}': p[f'backlash.{name}'] for name in ('m', 'c_r', 'c_l')},
    })
    run = build_closed_loop(known).run(case.samples + 1)
    noise = NOISE_TO_SWING * float(np.ptp(run.column('y')[-(case.samples // PERIODS):]))
    # With less noise the bound falls, but no faster: what was known before counts less.
    for _ in range(ITERATIONS):
        bound = float(bound_of(p.replaced({'output_noise_std': noise}), run.column('v')[:-1]).max())
        if bound <= told:
            break
        noise *= CLOSER * told / bound
    return noise
