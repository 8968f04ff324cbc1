"""A driver that the test plays in real time: a plant behind a backlash, and whatever goes wrong."""

import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.publisher import Publisher
from ros_processes import NodeProcess, Probe, RosWorld, wait_until
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core import Parameters, build_plant, build_reference

NOISE = 1e-3
# Long enough that other processes do not make every command late. A sample of the loop is that of
# the paper's example, only later.
PERIOD_S = 0.03
OF_THE_LOOP = {'sample_period': PERIOD_S, 'estimator.output_noise_std': NOISE}
TRUTH = {'m': 1.3, 'c_r': 3.0, 'c_l': -3.0}
# Beyond every swing of the paper's example: a loop that goes there is unstable.
LARGEST_V, LARGEST_Y = 100.0, 100.0
LATEST = 0.5  # of a period, after which it is too late to send an output

Sent = Callable[[int, float], list[float]]


class PacedDriver:
    """Applies the newest v and publishes y every sample period, and the reference with it.

    sent: what of y(k) leaves the driver, as many messages as it likes.
    """

    def __init__(self, probe: Probe, reports_applied: bool = False) -> None:
        p = Parameters({
            'output_noise_std': NOISE, 'sample_period': PERIOD_S, 'frequency': 0.06 / PERIOD_S})
        self.probe = probe
        self.plant, self._signal = build_plant(p), build_reference(p)
        self.sent: Sent = lambda k, y: [y]
        self.k = 0
        self.v = 0.0
        self.y: list[float] = []
        self._start = time.monotonic()
        self.controls = probe.collect(topics.CONTROL, Float64)
        self.estimates = probe.collect(topics.ESTIMATES, Float64MultiArray)
        self.signals = probe.collect(topics.SIGNALS, Float64MultiArray)
        self._diagnostics = probe.collect(topics.DIAGNOSTICS, DiagnosticArray)
        self.reference = probe.publisher(topics.REFERENCE, Float64)
        self.applied: Publisher | None = None
        if reports_applied:
            self.applied = probe.publisher(topics.APPLIED_CONTROL, Float64)
        self.output = probe.publisher(topics.PLANT_OUTPUT, Float64)

    def meet(self, controller: NodeProcess) -> None:
        node = self.probe.node
        self.probe.wait_until(
            lambda: (
                controller.events('ready') and self.output.get_subscription_count() > 0
                and self.reference.get_subscription_count() > 0
                and node.count_publishers(topics.ESTIMATES) > 0
                and node.count_publishers(topics.CONTROL) > 0
                and (self.applied is None or self.applied.get_subscription_count() > 0)),
            'the controller')
        self.rest()

    def run(self, samples: int) -> None:
        for _ in range(samples):
            self._tick()

    def run_until(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, self._tick)

    def learn(self) -> None:
        self.run_until_known(0.02)
        self.run(20)
        self.run_until_known(0.02)

    def run_until_known(self, error: float) -> None:
        self.run_until(lambda: self.error() < error, f'estimates within {error:.0%}')

    def rest(self) -> None:
        self._start = time.monotonic() - self.k * PERIOD_S

    def status(self) -> DiagnosticStatus | None:
        statuses = [message.status[0] for message in self._diagnostics]
        return next((s for s in reversed(statuses) if s.name == 'controller'), None)

    def says(self, words: str) -> bool:
        """Whether the newest diagnostics hold these words, be it as one finding of several."""
        status = self.status()
        return status is not None and any(
            words in text for text in (status.message, *(pair.value for pair in status.values)))

    def text(self, key: str) -> str:
        status = self.status()
        values: dict[str, Any] = {v.key: v.value for v in status.values} if status else {}
        return str(values.get(key, ''))

    def value(self, key: str) -> float:
        return float(self.text(key) or 0.0)

    def estimate(self) -> dict[str, float]:
        return dict(zip(('m', 'c_r', 'c_l'), self.estimates[-1].data, strict=False))

    def error(self) -> float:
        if not self.estimates:
            return 1.0
        estimate = self.estimate()
        return max(abs(estimate[name] / true - 1.0) for name, true in TRUTH.items())

    def check_sanity(self) -> None:
        commands = [message.data for message in self.controls]
        assert max(map(abs, commands)) < LARGEST_V
        assert max(map(abs, self.y)) < LARGEST_Y

    def _tick(self) -> None:
        while (left := self._start + (self.k + 1) * PERIOD_S - time.monotonic()) > 0.0:
            self.probe.spin(left)
        self.probe.spin(0.0)
        if self.controls:
            self.v = self.controls[-1].data
        # The plant does not wait for a test that was held up, which then has nothing to send.
        passed = (time.monotonic() - self._start) / PERIOD_S
        while self.k < int(passed):
            self._advance()
        if passed - self.k > LATEST:
            return
        y = self.plant.measure()
        self.y.append(y)
        for value in self.sent(self.k, y):
            self.output.publish(Float64(data=value))
        self.reference.publish(Float64(data=self._signal((self.k + 1) * PERIOD_S)))

    def _advance(self) -> None:
        if self.applied is not None:
            self.applied.publish(Float64(data=self.v))
        self.plant.step(self.v)
        self.k += 1


def controller_and_driver(
    world: RosWorld, reports_applied: bool = False, **parameters: object,
) -> tuple[NodeProcess, PacedDriver]:
    controller = world.start('controller', {**OF_THE_LOOP, **parameters})
    driver = PacedDriver(world.probe(), reports_applied=reports_applied)
    driver.meet(controller)
    return controller, driver

