"""A control loop beside a driver in simulated time, for tests of what either may do to the other.

Plant, driver and clock are those of the fault campaign, benchmarks/fault_loop.
"""

from collections.abc import Callable

import numpy as np
from fault_loop.fault_controller import Controller
from fault_loop.fault_world import Actuator, Driver, Sensor

from backlash_ros.core import Estimate, Parameters
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.sample_counter import Output

NOISE = 1e-3
TRUTH = np.array([1.3, 3.0, -3.0])  # m, c_r, c_l of the paper's example
# Beyond every swing of that example: a loop that goes there is unstable.
LARGEST = 100.0
MOST_ROUNDS = 15  # of 100 samples

Fault = Callable[[int, Output], list[Output]]


def as_sent(k: int, output: Output) -> list[Output]:
    return [output]


class SimulatedLoop:
    """The paper's example, or another one.

    fault: what becomes of an output on its way. deaf: whether the driver misses a command.
    referred: whether y_m is published. sent: every command.
    """

    def __init__(self, reports: bool = False, v: float | None = None, **values: object) -> None:
        self.p = Parameters({
            'output_noise_std': NOISE, 'estimator.output_noise_std': NOISE, **values})
        self.rng = np.random.default_rng(7)
        self.sensor = Sensor(self.rng, swing=10.0)
        self.driver = Driver(self.p, self.rng, Actuator(), self.sensor, reports)
        self.fault: Fault = as_sent
        self.deaf: Callable[[], bool] = lambda: False
        self.referred = True
        self.sent: list[float] = []
        self.rows: list[Estimate] = []  # one for each command that answers an output
        self.controller = Controller(
            self.p, self.driver, None, lambda v, limits: self.sent.append(v),
            lambda step, renewed: self.rows.append(step.estimate))
        if v is not None:
            self.controller.restart(None, v)

    @property
    def loop(self) -> ControlLoop:
        return self.controller.loop

    def run(self, samples: int) -> None:
        driver = self.driver
        for _ in range(samples):
            before = driver.actuator.v
            driver.advance()
            driver.outputs = [
                each for output in driver.outputs for each in self.fault(driver.tick, output)]
            y_m = driver.reference(driver.tick * self.p.sample_period)
            self.controller.run(y_m if self.referred else None)
            if self.deaf():
                driver.actuator.v = before

    def learn(self, error: float = 0.02) -> None:
        """Run until no estimate is off by more than a share, and for some time after it."""
        for _ in range(MOST_ROUNDS):
            self.run(100)
            if self.error() < error:
                break
        self.run(50)
        assert self.error() < error

    def error(self) -> float:
        e = self.loop.estimate
        return float(np.abs(np.array([e.m, e.c_r, e.c_l]) / TRUTH - 1.0).max())

    def check_sanity(self) -> None:
        assert np.isfinite(self.sent).all()
        assert np.abs(self.sent).max() < LARGEST
        assert abs(self.driver.plant.measure()) < LARGEST
