"""Hypothesis strategies and stand-ins shared by the tests of the core."""

from dataclasses import dataclass
from math import nan

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import signal

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction

PAPER_NUMERATOR = (1e-5, 4e-5, 1e-5)
PAPER_DENOMINATOR = (1.0, -2.88504, 2.77196, -0.88692)


@dataclass(frozen=True)
class Play:
    """A valid backlash: m > 0, c_l < c_r."""

    m: float
    c_r: float
    c_l: float

    @property
    def gap(self) -> float:
        return self.c_r - self.c_l

    def rounding(self, u: float) -> float:
        return 1e-12 * (1.0 + abs(u) + self.m * (abs(self.c_r) + abs(self.c_l)))


@st.composite
def plays(draw: st.DrawFn) -> Play:
    m = draw(st.floats(0.05, 20.0))
    c_l = draw(st.floats(-50.0, 50.0))
    return Play(m, c_l + draw(st.floats(0.01, 50.0)), c_l)


@st.composite
def usual_plays(draw: st.DrawFn) -> Play:
    return Play(
        draw(st.floats(0.1, 10.0)), draw(st.floats(0.05, 20.0)), draw(st.floats(-20.0, -0.05)))


def signals(size: float = 100.0, min_size: int = 1, max_size: int = 60) -> st.SearchStrategy:
    value = st.one_of(st.floats(-size, size), st.integers(-3, 3).map(float))
    return st.lists(value, min_size=min_size, max_size=max_size)


def eighths(low: int, high: int) -> st.SearchStrategy:
    return st.integers(low, high).map(lambda i: i / 8.0)


@st.composite
def plants(draw: st.DrawFn, integrating: bool | None = None) -> TransferFunction:
    """A stable or integrating G(z) of order 1 to 5, minimum phase or not, with extra delay or not.

    Zeros keep away from the unit circle, where no lag is long enough.
    """
    order = draw(st.integers(1, 5))
    if integrating is None:
        integrating = draw(st.booleans())
    poles: list[complex] = [1.0] if integrating else []
    poles += _roots(draw, order - len(poles), st.floats(0.05, 0.95))
    zeros = _roots(
        draw, draw(st.integers(0, order - 1)), st.one_of(st.floats(0.0, 0.6), st.floats(2.0, 5.0)))
    gain = draw(st.floats(0.01, 100.0))
    # Unit gain at z = 1 (per sample, for an integrator) keeps y of the size of u.
    numerator = np.real(np.poly(zeros)) if zeros else np.ones(1)
    numerator = gain * numerator / np.sum(np.abs(numerator))
    return TransferFunction(numerator.tolist(), np.real(np.poly(poles)).tolist())


def _roots(draw: st.DrawFn, count: int, radii: st.SearchStrategy) -> list[complex]:
    roots: list[complex] = []
    while len(roots) < count:
        radius = draw(radii)
        if count - len(roots) >= 2 and draw(st.booleans()):
            root = radius * np.exp(1j * draw(st.floats(0.2, 3.0)))
            roots += [root, np.conj(root)]
        else:
            # A real pole left of the origin rings at the Nyquist frequency: small ones only.
            roots.append(radius if draw(st.booleans()) else -radius)
    return roots


# Second order, 20 Hz, damping 0.5, at 200 Hz, as in geared_motor.yaml.
GEAR: dict[str, object] = {
    'sample_period': 0.005, 'plant.numerator': [0.15678154198771987, 0.12688103331610767],
    'plant.denominator': [1.0, -1.2498255157872757, 0.5334880910911033]}


def known_backlash(m: float, c_r: float, c_l: float) -> dict[str, object]:
    """The backlash of the plant, and the same told to the law that learns none."""
    values = {'m': m, 'c_r': c_r, 'c_l': c_l}
    return {'estimator.law': 'fixed', **{f'{of}.{name}': value for name, value in values.items()
                                         for of in ('backlash', 'estimator.initial')}}


def paper_example(**changes: object) -> Parameters:
    """The paper's example with LMS and a noise-free output; `__` in a name stands for a dot."""
    values: dict[str, object] = {'estimator.law': 'lms', 'estimator.output_noise_std': 0.0}
    values.update({name.replace('__', '.'): value for name, value in changes.items()})
    return Parameters(values)


def output_of(model: TransferFunction, u: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(signal.lfilter(model.numerator, model.denominator, u))


class KnownInput:
    """Stands in for InputReconstruction where u is known: hand u(k-1) over as y(k)."""

    std, innovation, lag, ready = 0.0, nan, 1, True

    def __init__(self) -> None:
        self.u_hat = 0.0

    def newer(self, samples: int) -> float:
        return self.u_hat

    def update(self, y: float) -> float:
        self.u_hat = y
        return y
