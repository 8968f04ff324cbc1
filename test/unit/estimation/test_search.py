"""The search takes the beginning of the play in closed form: where it was hides no gap."""

import numpy as np

from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.search import search
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import lfilter
from backlash_ros.core.plant.transfer_function import TransferFunction


def test_a_beginning_between_those_compared_changes_nothing() -> None:
    # It lasts while v stays within the gap; after an integrator, what it is off by is a drift.
    family = PlantFamily(TransferFunction([0.0, 0.1], [1.0, -1.0]), 0.0)
    k, gap = np.arange(80), 2.3
    v = np.where(k < 40, 0.2, 4.0) * np.sin(0.3 * k)
    b, a = family.at([])
    noise = 1e-3 * np.random.default_rng(1).standard_normal(len(k))
    found = []
    for share in (0.07, 0.18, 0.41, 0.6):
        y = lfilter(b, a, play(v, gap, v[0] + share * gap)) + noise
        found.append(search(family, v, y, 1e-3, 50.0, np.zeros(0))[0][0])
    assert len({round(one.gap, 6) for one in found}) == 1
