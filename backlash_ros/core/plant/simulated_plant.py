"""The simulated plant: backlash, then G(z), then a sensor (3.1).

Its G(z) may differ from the known one by changes to the G(s), x' = A x + b u, that it samples:

    exp [A b; 0 0] = [A_z b_z; 0 1]     z = 1 stays an integrator, z = 0 stays a delay
    frequency    G(s / f) / f^k with k integrators: gain at rest, or of the velocity, is kept
    damping      s^2 + 2 d w s + w^2 with kappa d for d; the numerator of G(s) is kept
    dead time    of u, in front of G: exact for a u that is held over each sample
"""

import warnings
from math import sqrt

import numpy as np

from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import Backlash
from backlash_ros.core.plant.transfer_function import Array, Roots, TransferFunction


class SimulatedPlant:
    """y = G(z) (B[v] + d + w), measured with noise and a quantum.

    d is constant, w a random walk, w(k+1) = w(k) + walk_std sqrt(T) N(0, 1). model: the true G(z).
    actuator: turns the command into v. applied: the newest v. sample: number of the next one.
    """

    def __init__(
        self, p: Parameters, model: TransferFunction, actuator: Actuator | None = None,
    ) -> None:
        hidden = p.backlash
        self.backlash = Backlash(hidden.m, hidden.c_r, hidden.c_l, hidden.initial_u)
        self.applied, self.sample = 0.0, 0
        self._p, self._model, self._x = p, model, [0.0] * model.order
        self._motor = None if actuator is None else Motor(actuator)
        self._rng = np.random.default_rng(p.seed)
        # A generator of its own: the noise on y is the same with and without a walk.
        self._walk_rng = self._rng.spawn(1)[0]
        self._walk, self._walk_step = 0.0, p.truth.walk_std * sqrt(p.sample_period)

    @property
    def disturbance(self) -> float:
        return self._p.input_disturbance + self._walk

    def change(self, p: Parameters) -> None:
        """Apply other parameters; G(z), the actuator and the walk stay as they are."""
        self._p = p
        self._wear()

    def measure(self) -> float:
        """Return y(k) as the sensor shows it; to be called once per sample."""
        y = self._x[0]
        noise_std, quantum = self._p.output_noise_std, self._p.output_quantum
        if noise_std > 0.0:
            y += noise_std * float(self._rng.standard_normal())
        return quantum * round(y / quantum) if quantum > 0.0 else y

    def step(self, v: float) -> float:
        """Apply a command over one sample period and return u = B[v], without the disturbances."""
        if any(self._p.backlash.rate) or any(self._p.backlash.jump):
            self._wear()
        if self._motor is not None:
            held = self.backlash
            v = self._motor.step(v, held.u / held.m, held.c_r, held.c_l)
        self.applied = v
        u = self.backlash.step(v)
        self._model.advance(self._x, u + self.disturbance)
        self._walk += self._walk_step * float(self._walk_rng.standard_normal())
        self.sample += 1
        return u

    def _wear(self) -> None:
        hidden, t = self._p.backlash, self.sample * self._p.sample_period
        jump = hidden.jump if t >= hidden.jump_time else (0.0, 0.0, 0.0)
        m, c_r, c_l = (value + rate * t + step for value, rate, step in zip(
            (hidden.m, hidden.c_r, hidden.c_l), hidden.rate, jump, strict=True))
        self.backlash = Backlash(m, c_r, c_l, self.backlash.u)


def delayed(model: TransferFunction, samples: int) -> TransferFunction:
    """Return z^-samples G(z), with the delay as poles at 0."""
    denominator = np.append(model.denominator, np.zeros(samples))
    return TransferFunction(model.numerator.tolist(), denominator.tolist())


def altered_plant(
    model: TransferFunction, frequency: float = 1.0, damping: float = 1.0, lag: float = 0.0,
) -> TransferFunction:
    """Return the altered G(z); its coefficients stay the same if only whole samples are added.

    frequency, damping: factors on the natural frequency of every pole and on the damping ratio of
    every pair, > 0. lag: dead time of u [samples], >= 0. Raises ParameterError for a pole on the
    negative real axis, which no G(s) of this order has, and for one at 0 that is no delay.
    """
    whole = int(lag + 1e-9)
    part = max(lag - whole, 0.0)
    if frequency == 1.0 and damping == 1.0 and part <= 1e-9:
        return delayed(model, whole)
    from scipy.linalg import expm, logm  # takes long to load, and few plants need it

    numerator_z, denominator_z, delay = model.without_delay()
    inner = TransferFunction(numerator_z, denominator_z)
    poles, n = _continuous_poles(inner), inner.order
    sampled = _block(*inner.state_space()[:2])
    sampled[n, n] = 1.0
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)  # SciPy warns of an error of 1e-13
        block = np.real(logm(sampled))
    numerator = _numerator(block[:n, :n], block[:n, n], np.real(np.poly(poles)))
    poles = _damped(poles, damping) * frequency
    numerator *= frequency**(np.arange(1, n + 1) - np.count_nonzero(poles == 0.0))
    altered = TransferFunction(numerator.tolist(), np.real(np.poly(poles)).tolist())
    continuous = _block(*altered.state_space()[:2])
    over, over_part = expm(continuous * (1.0 - part)), expm(continuous * part)
    transition = over[:n, :n] @ over_part[:n, :n]
    denominator = np.real(np.poly(np.exp(poles)))
    b_z = np.append(_numerator(transition, over[:n, n], denominator), 0.0)
    # What was commanded a sample before acts for the first part of this one.
    b_z[1:] += _numerator(transition, over[:n, :n] @ over_part[:n, n], denominator)
    late = int(part > 1e-9)
    altered = TransferFunction(b_z[:n + late].tolist(), [*denominator, *[0.0] * late])
    return delayed(altered, delay + whole)


def _block(a: Array, b: Array) -> Array:
    """[a b; 0 0], whose exponential gives the response to a u that is held."""
    return np.vstack([np.column_stack([a, b]), np.zeros(len(a) + 1)])


def _numerator(a: Array, b: Array, denominator: Array) -> Array:
    """Return the numerator (n,) in z or s of (1, 0, ...) (z I - A)^-1 b, by Markov parameters."""
    markov = [b]
    for _ in range(len(a) - 1):
        markov.append(a @ markov[-1])
    product = np.convolve(denominator, [float(x[0]) for x in markov])
    return np.asarray(product[:len(a)], np.float64)


def _continuous_poles(model: TransferFunction) -> Roots:
    poles, why = model.poles, ''
    negative = (poles.real < 0.0) & (np.abs(poles.imag) <= 1e-6 * np.abs(poles))
    if model.denominator[-1] == 0.0:
        why = 'has poles at 0 that are no delay by whole samples:'
    elif negative.any():
        why = (f'has the pole {float(poles[negative][0].real):.6g}: no continuous plant has poles '
               'on the negative real axis, so that')
    if why:
        raise ParameterError(
            'plant.denominator', model.denominator.tolist(),
            f'{why} truth.scale_* and truth.extra_lag cannot alter it',
            'give truth.numerator and truth.denominator instead')
    # Rounding moves a double pole by 1e-8.
    return np.where(np.abs(poles - 1.0) < 1e-6, 0.0, np.log(poles))


def _damped(poles: Roots, factor: float) -> Roots:
    altered = list(poles[poles.imag == 0.0])
    for pole in poles[poles.imag > 0.0]:
        ratio = -factor * pole.real / abs(pole)
        root = np.sqrt(complex(ratio**2 - 1.0))
        altered += [abs(pole) * (-ratio + root), abs(pole) * (-ratio - root)]
    return np.array(altered, dtype=np.complex128)
