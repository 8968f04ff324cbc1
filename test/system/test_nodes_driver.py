"""The controller against a driver that the test plays: bad messages, silence, limits."""

from __future__ import annotations

from math import inf, nan
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros_processes import NodeProcess, Probe, RosWorld, ros_world
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.assembly import build_controller
from backlash_ros.core.parameters import Parameters


class Driver:
    """Publishes y and y_m, and listens to what the controller says."""

    def __init__(self, probe: Probe) -> None:
        self.probe = probe
        self.controls = probe.collect(topics.CONTROL, Float64)
        self._diagnostics = probe.collect(topics.DIAGNOSTICS, DiagnosticArray)
        self._reference = probe.publisher(topics.REFERENCE, Float64)
        self._output = probe.publisher(topics.PLANT_OUTPUT, Float64)

    def send_reference(self, y_m: float) -> None:
        self._reference.publish(Float64(data=y_m))

    def send_output(self, y: float) -> None:
        self._output.publish(Float64(data=y))

    def answer_to(self, y: float) -> float:
        """v that the controller answers with."""
        count = len(self.controls)
        self.send_output(y)
        self.probe.wait_until(lambda: len(self.controls) > count, 'an answer')
        return float(self.controls[-1].data)

    def controller_status(self) -> DiagnosticStatus | None:
        """The newest diagnostics of the controller."""
        statuses = [message.status[0] for message in self._diagnostics]
        return next((s for s in reversed(statuses) if s.name == 'controller'), None)

    def counter(self, key: str) -> int:
        """A counter in the newest diagnostics."""
        status = self.controller_status()
        values: dict[str, Any] = {v.key: v.value for v in status.values} if status else {}
        return int(values.get(key, 0))


def start_controller(world: RosWorld, **parameters: object) -> tuple[NodeProcess, Driver]:
    """A controller that answers the driver, with the reference at 5."""
    controller = world.start('controller', {'wait_for_subscribers': 1, **parameters})
    driver = Driver(world.probe())
    probe = driver.probe

    def is_ready() -> bool:
        driver.send_reference(5.0)
        return bool(controller.events('ready'))

    probe.wait_until(is_ready, 'the controller')
    probe.wait_until(
        lambda: probe.node.count_subscribers(topics.PLANT_OUTPUT) > 0, 'its subscription'
    )

    def is_answered() -> bool:
        driver.send_output(0.0)
        return bool(driver.controls)

    probe.wait_until(is_answered, 'the first answer')
    return controller, driver


def test_non_finite_messages_are_counted_and_leave_the_control_alone(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = start_controller(
            world, **{'timeout.plant_output': 0.3, 'estimator.law': 'lms'}
        )
        for dropped, (bad_y, bad_reference) in ((2, (nan, inf)), (4, (-inf, nan))):
            driver.send_reference(bad_reference)
            driver.send_output(bad_y)
            # One at a time: the controller skips what waits behind a newer message.
            driver.probe.wait_until(
                lambda dropped=dropped: driver.counter('non-finite dropped') == dropped,
                'dropped messages',
            )
        driver.answer_to(0.0)
        # At rest the law learns nothing: a controller that saw only the good messages agrees.
        undisturbed = build_controller(Parameters({'estimator.law': 'lms'}))
        assert [control.data for control in driver.controls] == [
            undisturbed.step(0.0, 5.0).v for _ in driver.controls
        ]
        driver.probe.wait_until(
            lambda: 'no plant_output' in getattr(driver.controller_status(), 'message', ''),
            'a word about the silence',
        )
        status = driver.controller_status()
        assert status is not None
        assert status.level == DiagnosticStatus.WARN
        assert controller.stop() == 0
        assert 'non-finite dropped: 4' in controller.stderr
        assert 'no plant_output for 0.3 s: is the driver running?' in controller.stderr
