"""What a user sees of the nodes in the terminal alone: what has started, what is wrong, the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from math import nan, sin
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import NodeProcess, Probe, ros_world
from std_msgs.msg import Float32, Float64

from backlash_ros import topics
from backlash_ros.core.loop.causes import LONGEST_TEXT

PERIOD_S = 0.01
BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Terminal:
    """A controller and what it writes while somebody plays its driver."""

    def __init__(self, probe: Probe, controller: NodeProcess) -> None:
        self.probe, self.controller = probe, controller
        self._reference = probe.publisher(topics.REFERENCE, Float64)
        self._diagnostics = probe.collect(topics.DIAGNOSTICS, DiagnosticArray)

    def send_until(
        self, output: Publisher | None, line: str, message: Callable[[float], Any] = lambda y: (
            Float64(data=y)), period_s: float = PERIOD_S,
    ) -> None:
        """Play the driver until the controller has written this line."""
        k = count()
        next_s = time.monotonic()

        def tick() -> bool:
            nonlocal next_s
            if time.monotonic() >= next_s:
                next_s += period_s
                self._reference.publish(Float64(data=1.0))
                if output is not None:
                    output.publish(message(sin(next(k))))
            return line in self.controller.stderr

        self.probe.wait_until(tick, line)

    def texts(self) -> list[str]:
        """Messages of /diagnostics so far."""
        statuses = [message.status[0] for message in self._diagnostics]
        assert all(status.hardware_id == '/control' for status in statuses)
        return [status.message for status in statuses]

    @contextmanager
    def publisher(self, message_type: type[Any], qos: QoSProfile | int = 10) -> Iterator[Publisher]:
        """A publisher of plant_output for a while."""
        publisher = self.probe.node.create_publisher(message_type, topics.PLANT_OUTPUT, qos)
        yield publisher
        self.probe.node.destroy_publisher(publisher)


def test_each_cause_is_one_line_in_the_terminal_and_in_the_diagnostics(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'timeout.plant_output': 0.3})
        terminal = Terminal(world.probe(), controller)
        probe = terminal.probe
        probe.wait_until(
            lambda: probe.node.count_subscribers(topics.PLANT_OUTPUT) > 0, 'the controller'
        )
        # Somebody listens, as a driver does.
        probe.collect(topics.CONTROL, Float64)
        terminal.send_until(None, '[WARN]')
        with terminal.publisher(Float32) as output:
            terminal.send_until(
                output, 'plant_output is sent as Float32, Float64 is wanted: change /probe',
                lambda y: Float32(data=y),
            )
        with terminal.publisher(Float64, BEST_EFFORT) as output:
            terminal.send_until(output, 'sent best effort, which does not arrive: set io.best')
        with terminal.publisher(Float64) as output:
            terminal.send_until(
                output, 'Hz, sample_period is 0.01 s (100 Hz): correct one of them', period_s=0.04
            )
            terminal.send_until(
                output, 'of plant_output is no finite number: check the sensor',
                lambda y: Float64(data=nan),
            )
            terminal.send_until(None, 'no plant_output for 0.3 s: is the driver running?')
        texts = terminal.texts()
        assert controller.stop() == 0
    assert max(map(len, texts)) <= LONGEST_TEXT
    for cause in ('sent as Float32', 'best effort', '(100 Hz)', 'no finite', 'no plant_output'):
        assert any(cause in text for text in texts)


def test_every_node_says_what_it_is_about_and_the_recorder_what_it_has_recorded(
    tmp_path: Path,
) -> None:
    bag = tmp_path / 'bag'
    with ros_world(tmp_path) as world:
        nodes = {
            name: world.start(name, parameters, *others) for name, parameters, others in (
                ('controller', {}, ('--ros-args', '-r', '__ns:=/arm')), ('plant', {}, ()),
                ('reference', {'waveform': 'square'}, ()), ('recorder', {'bag': f"'{bag}'"}, ()),
            )
        }
        waiting = world.start('controller', {'autostart': False})
        probe = world.probe()
        for node in (*nodes.values(), waiting):
            probe.wait_until(lambda node=node: 'started: ' in node.stderr, f'{node.executable}')
        probe.spin(0.5)
        assert all(node.stop() == 0 for node in (*nodes.values(), waiting))
    for name, content in (
        ('controller', '/arm/plant_output and /arm/reference in, /arm/control out, '
         'sample_period 0.01 s (100 Hz); waits for reference and plant_output'),
        ('plant', '/control in, /plant_output out'), ('reference', '/reference out: square'),
        ('recorder', f'records to {bag} (mcap)'),
    ):
        (line,) = [line for line in nodes[name].stderr.splitlines() if 'started: ' in line]
        assert content in line
        assert '[INFO]' in line
    assert 'autostart is false: waits for ros2 lifecycle set /controller configure' \
        in waiting.stderr
    assert f' to {bag}' in nodes['recorder'].stderr.split('recorded ')[1]
