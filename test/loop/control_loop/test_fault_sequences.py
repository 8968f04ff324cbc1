"""Some of the sequences that benchmarks/faults.py plays by the thousand, and single faults."""

import numpy as np
import pytest
from fault_loop.fault_controller import Controller
from fault_loop.fault_sequences import Sequence
from fault_loop.fault_world import Actuator, Driver, Sensor

from backlash_ros.core.parameters import Parameters

PERIOD_NS = 10_000_000
TIMEOUT_NS = 200_000_000


# In 188 limits change while v is led to zero, in 6351 v is on its way over the gap; in 13592 and
# 15977 others leave v far out, for `tracking` and `proportional`; in 17291 an `lms` that was at the
# bound of m is interrupted.
@pytest.mark.parametrize('seed', [2, 5, 8, 188, 6351, 13592, 15977, 17291])
@pytest.mark.filterwarnings('ignore')
def test_no_sequence_of_faults_breaks_a_limit_or_makes_v_jump(seed: int) -> None:
    found = Sequence(seed).run()
    assert found.commands > 0
    assert [found.outside, found.too_fast, found.jumps, found.unbounded] == [[], [], [], []]


@pytest.mark.parametrize('seed', [113, 204, 206, 269])
@pytest.mark.filterwarnings('ignore')
def test_saved_estimates_of_another_plant_are_never_said_to_track(seed: int) -> None:
    assert Sequence(seed).run().wrong_inherited == []


class World:
    """A loop of the paper's example beside a driver."""

    def __init__(self) -> None:
        p = Parameters({'estimator.law': 'fixed', 'timeout.plant_output': 1e-9 * TIMEOUT_NS})
        rng = np.random.default_rng(1)
        self.driver = Driver(p, rng, Actuator(), Sensor(rng, 1.0), reports=False)
        self.controller = Controller(
            p, self.driver, None, lambda v, limits: None, lambda step, renewed: None
        )
        self.statistics = self.controller.loop.statistics

    def run(self, samples: int) -> None:
        for _ in range(samples):
            self.driver.advance()
            self.controller.run(self.driver.reference(0.01 * self.driver.tick))


@pytest.mark.parametrize(('jump_ns', 'interruptions', 'lost'), [
    (TIMEOUT_NS + PERIOD_NS, 1, 21), (-TIMEOUT_NS, 1, 0), (TIMEOUT_NS // 2, 0, 10),
])
def test_a_clock_that_is_set_is_an_interruption_or_taken_for_lost_outputs(
    jump_ns: int, interruptions: int, lost: int,
) -> None:
    world = World()
    world.run(100)
    world.driver.offset_ns += jump_ns
    world.run(100)
    assert world.statistics.interruptions == interruptions
    assert world.statistics.lost == lost
