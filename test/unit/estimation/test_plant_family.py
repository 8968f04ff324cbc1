"""G(z; xi) holds the plants that are likely to be there, with exact derivatives."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import cont2discrete

from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.plant.simulated_plant import altered_plant
from backlash_ros.core.plant.transfer_function import TransferFunction

PLANTS = {
    'one pole': ([0.3], [1.0, -0.7]), 'integrator': ([0.1], [1.0, -1.7, 0.7]),
    'three poles': ([0.2, 0.1, 0.02], [1.0, -1.2, 0.4, -0.03]),
    'delayed, real poles': ([0.1, 0.05], [1.0, -1.3, 0.4, 0.0]),
}


def two_poles(omega_t: float) -> TransferFunction:
    b, a, _ = cont2discrete(([omega_t**2], [1.0, omega_t, omega_t**2]), 1.0)
    return TransferFunction(b[0, 1:].tolist(), a.tolist())


@pytest.mark.parametrize('plant', PLANTS.values(), ids=PLANTS)
def test_slopes_are_those_of_the_coefficients(plant: tuple[list[float], list[float]]) -> None:
    family, step = PlantFamily(TransferFunction(*plant), 0.2), 1e-6
    xi = np.linspace(0.3, -0.4, family.count)
    for slopes in zip(*family.slopes(xi.tolist()), strict=True):
        assert all(np.isfinite(part).all() for part in slopes)
    for j, (db, da) in enumerate(zip(*family.slopes(xi.tolist()), strict=True)):
        ahead, behind = (family.at((xi + sign * step * np.eye(len(xi))[j]).tolist())
                         for sign in (1.0, -1.0))
        for slope, above, below in zip((db, da), ahead, behind, strict=True):
            found = (np.array(above) - below) / (2.0 * step)
            np.testing.assert_allclose(slope[:len(found)], found, atol=1e-8)


@pytest.mark.parametrize('omega_t', [0.13, 1.0, 2.5])
@pytest.mark.parametrize('lag', [0.0, 0.3, 1.0, 2.6])
def test_dead_time_and_another_frequency_are_among_them(omega_t: float, lag: float) -> None:
    family = PlantFamily(two_poles(omega_t), 0.2)
    true = altered_plant(two_poles(omega_t), 0.9, 1.0, lag)
    z = np.exp(1j * np.linspace(0.05, 3.0, 60))

    def apart(xi: np.ndarray) -> np.ndarray:
        off = family.model_at(xi.tolist()).response(z) - true.response(z)
        return np.concatenate([off.real, off.imag])

    begins = [[(lag + by) / family._scales[0][0], 0.0, 0.0, 0.0] for by in (-0.2, 0.1, 0.2)]
    assert min(abs(least_squares(apart, begin).fun).max() for begin in begins) < 1e-6
