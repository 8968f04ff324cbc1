"""The whole loop in one process: reference, controller and simulated plant."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from backlash_ros.core.assembly import build_controller, build_plant, build_reference
from backlash_ros.core.control.controller import AdaptiveController
from backlash_ros.core.loop.learned_model import learned_model_of
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.simulated_plant import SimulatedPlant
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, row_of


@dataclass
class ClosedLoop:
    """Controller, plant and reference stepped together; row k holds sample k.

    lose: says of each sample whether y(k) is lost on the way. told: G(z) as the parameters have it.
    """

    controller: AdaptiveController
    plant: SimulatedPlant
    reference: Callable[[float], float]
    sample_period: float
    p: Parameters
    lose: Callable[[], bool] = field(default=lambda: False)

    def run(self, samples: int, on_sample: Callable[[int], None] | None = None) -> RunRecord:
        """Simulate and return every signal; on_sample(k) is called after each sample."""
        values = array('d')  # row by row: NumPy takes longer to take in a row
        lost, v = 0, 0.0
        for k in range(samples):
            t = k * self.sample_period
            y = self.plant.measure()
            if k > 0 and self.lose():
                lost += 1
                self.plant.step(v)
            else:
                step = self.controller.step(y, self.reference(t), lost)
                self.controller.refine()
                lost, v = 0, step.v
                u, truth = self.plant.step(v), self.plant.backlash
                values.extend(row_of(
                    t, y, v, u, step, self.controller.estimator, (truth.m, truth.c_r, truth.c_l)
                ))
            if on_sample is not None:
                on_sample(k)
        return RunRecord(
            np.array(values).reshape(-1, len(COLUMNS)), self.sample_period,
            self.controller.lost_samples + lost,
            learned_model_of(self.controller.estimator, self.p),
        )


def build_closed_loop(p: Parameters) -> ClosedLoop:
    """The loop of the given parameters; the seed also draws which outputs are lost."""
    loss = p.output_loss
    rng = np.random.default_rng([p.seed, 1])
    return ClosedLoop(
        build_controller(p),
        build_plant(p),
        build_reference(p),
        p.sample_period,
        p,
        lambda: loss > 0.0 and float(rng.random()) < loss,
    )
