"""The nodes as processes: what they refuse and say, how they end, what goes on after them."""

import json
import re
import signal
import subprocess
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from drivers.paced_driver import OF_THE_LOOP, PERIOD_S, TRUTH, PacedDriver, controller_and_driver
from places import ROOT
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from ros_processes import NodeProcess, ros_world, wait_until
from std_msgs.msg import Float32, Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import complete_model

TYPES = {'std_msgs/msg/Float64': Float64, 'std_msgs/msg/Float64MultiArray': Float64MultiArray}
# What the shipped layouts draw: PlotJuggler writes /topic/field[0], Foxglove /topic.field[0].
SHOWN = {
    'plotjuggler.xml': r'(?:name|curve_x|curve_y)="(/\S+)/(\w+)(?:\[(\d+)\])?"',
    'foxglove.json': r'"value": *"(/[\w/]+)\.(\w+)(?:\[(\d+)\])?"',
}
# Topic, field and index, -1 without one.
PATHS = {
    (topic, field, int(index or -1)) for name, path in SHOWN.items()
    for topic, field, index in re.findall(path, (ROOT / 'config' / name).read_text())
}
RATE_MAX = 150.0
STEP = RATE_MAX * PERIOD_S * (1.0 + 1e-9)
STANDING = 5.13  # v at which a driver is found

UNKNOWN_YAML = '/**: {ros__parameters: {estimator: {initial: {mm: 1.0}}}}'
UNREADABLE_YAML = '/**: {ros__parameters: {plant: {denominator: [1, -2.5]}}}'


def test_bad_input_ends_a_node_with_one_line_and_exit_code_2(tmp_path: Path) -> None:
    for name, text in (('unknown', UNKNOWN_YAML), ('unreadable', UNREADABLE_YAML)):
        (tmp_path / f'{name}.yaml').write_text(text)
    (tmp_path / 'bag').mkdir()
    cases: list[tuple[str, list[str], str]] = [
        ('controller', ['-p', 'sample_period:=-0.01'], 'sample_period=-0.01 must be > 0 [s]'),
        ('controller', ['-p', 'estimator.use_applied_control:=1'],
         'estimator.use_applied_control=1 must be one of auto, true, false'),
        ('controller', ['--params-file', str(tmp_path / 'unknown.yaml')],
         'did you mean estimator.initial.m?'),
        ('plant', ['--params-file', str(tmp_path / 'unreadable.yaml')],
         'write all numbers of a list with a decimal point'),
        ('reference', ['-p', 'amplitude'], "'-p amplitude'"),
        ('recorder', ['-p', f"bag:='{tmp_path / 'bag'}'"], 'exists already: name a new folder')]
    with ros_world(tmp_path) as world:
        nodes = [
            world.start(executable, None, '--ros-args', *arguments)
            for executable, arguments, _ in cases]
        nodes.append(world.start('reference', None, '--amplitude', '3'))
        answers = [(node.wait(), node.stderr) for node in nodes]
    complaints = [complaint for *_, complaint in cases] + ['unrecognized arguments: --amplitude 3']
    for node, (code, stderr), complaint in zip(nodes, answers, complaints, strict=True):
        assert complaint in stderr
        assert stderr.startswith(f'{node.executable}: ')
        assert (code, stderr.count('\n')) == (2, 1), stderr
        assert 'Traceback' not in stderr


def test_every_node_says_what_it_is_about_and_ends_of_a_signal_with_code_0(tmp_path: Path) -> None:
    bag, mine = tmp_path / 'bag', tmp_path / 'mine.yaml'
    mine.write_text('/plant: {ros__parameters: {seed: 7}}\n')
    content = {
        'controller': '/arm/plant_output and /arm/reference in, /arm/control out, '
        'sample_period 0.01 s (100 Hz); waits for reference and plant_output',
        'plant': '/arm/control in, /arm/plant_output out',
        'reference': '/reference out: square',
        'recorder': f'records to {bag} (mcap)'}
    arm = ('--ros-args', '-r', '__ns:=/arm')
    with ros_world(tmp_path) as world:
        nodes = {
            'controller': world.start('controller', {'control.max': 12}, *arm),
            'plant': world.start(
                'plant', {'plant.numerator': [1, 2]}, *arm, '--params-file', str(mine)),
            'reference': world.start(
                'reference', {'waveform': 'square'}, '--ros-args', '--params-file', str(mine)),
            'recorder': world.start('recorder', {'bag': f"'{bag}'"})}
        for node in nodes.values():
            node.wait_for('ready')
        for i, node in enumerate(nodes.values()):
            node.send((signal.SIGINT, signal.SIGTERM)[i % 2])
        assert [node.wait() for node in nodes.values()] == [0] * 4
    for name, node in nodes.items():
        (line,) = [line for line in node.stderr.splitlines() if 'started: ' in line]
        assert content[name] in line
        assert 'Traceback' not in node.stderr
    # Of the section for a node of the same name elsewhere, that node alone is warned.
    assert [name for name, node in nodes.items() if 'mine.yaml' in node.stderr] == ['plant']
    assert f' to {bag}' in nodes['recorder'].stderr.split('recorded ')[1]
    assert (bag / 'metadata.yaml').is_file()


def catches(node: NodeProcess, number: signal.Signals) -> bool:
    status = Path(f'/proc/{node.process.pid}/status').read_text()
    caught = next(line for line in status.splitlines() if line.startswith('SigCgt'))
    return bool(int(caught.split()[1], 16) >> (number - 1) & 1)


def test_signals_at_the_start_and_until_the_very_end_do_no_harm(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False  # start and end of the interpreter are part of it
        for i in range(4):
            node = world.start('controller')
            # Before the interpreter has come to this package, nothing can be done about it;
            # SIGINT it catches by itself.
            wait_until(lambda node=node: catches(node, signal.SIGTERM), 'a handler', lambda: None)
            with suppress(subprocess.TimeoutExpired):
                node.process.wait(0.25 * i)
            assert node.stop((signal.SIGINT, signal.SIGTERM)[i % 2]) == 0, node.stderr
        for number in (signal.SIGINT, signal.SIGTERM):
            reference = world.start('reference')
            reference.wait_for('ready')
            wait_until(
                lambda node=reference, number=number: (
                    node.send(number) or node.process.poll() is not None
                ), 'the end', lambda: None)
            assert reference.process.returncode == 0


def test_estimates_are_saved_before_a_long_ramp_and_sigterm_ends_it(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{
            'estimates.file': str(file), 'estimates.save_period': 0.0, 'on_stop': 'ramp',
            'control.rate_max': RATE_MAX, 'timeout.ramp': 3600.0})
        driver.learn()
        driver.run_until(lambda: abs(driver.v) > 3.0, 'a v away from 0')
        # So that the ramp is not over before anybody has looked at it.
        client = AsyncParameterClient(driver.probe.node, 'controller')
        driver.run_until(client.services_are_ready, 'the parameters')
        slowed = client.set_parameters([Parameter('control.rate_max', value=0.01)])
        driver.run_until(slowed.done, 'a slower ramp')
        controller.send(signal.SIGINT)
        driver.run_until(file.exists, 'saved estimates')
        controller.send(signal.SIGINT)  # as a terminal and ros2 launch send it, both at once
        driver.run(30)
        assert controller.process.poll() is None
        controller.send(signal.SIGTERM)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert 'is held: SIGTERM came before it reached zero' in controller.stderr
        steps = [abs(b.data - a.data) for a, b in pairwise(driver.controls[-20:])]
        assert max(steps) < 0.011 * PERIOD_S
        # They are of no use where the samples are others.
        other = world.start('controller', {
            'estimates.file': str(file), 'estimates.load': True, 'sample_period': 0.01})
        assert other.wait() == 2
        assert 'was learned with sample_period=0.03, which is now 0.01' in other.stderr
        assert other.stderr.count('\n') == 1


def saved_error(file: Path) -> float:
    if not file.exists():
        return 1.0
    saved = json.loads(file.read_text())['estimate']
    return max(abs(saved[name] / true - 1.0) for name, true in TRUTH.items())


def test_a_killed_controller_goes_on_with_the_saved_estimates_and_without_a_jump(tmp_path):
    file = tmp_path / 'estimates.json'
    keep = {'estimates.file': str(file), 'estimates.load': True, 'estimates.save_period': 0.2,
            'control.rate_max': RATE_MAX, **OF_THE_LOOP}
    with ros_world(tmp_path) as world:
        driver = PacedDriver(world.probe(), reports_applied=True)
        driver.v = STANDING
        first = world.start('controller', keep)
        driver.meet(first)
        driver.learn()
        driver.run_until(lambda: saved_error(file) < 0.02, 'saved estimates within 2 %')
        first.kill()
        driver.run(20)  # what the killed one had still said
        rows = len(driver.estimates)
        again = world.start('controller', keep)
        driver.run_until(lambda: len(driver.estimates) > rows + 50, 'new rows')
        assert driver.estimates[rows].data[:3].tolist() == pytest.approx([1.3, 3.0, -3.0], rel=0.05)
        for row in driver.estimates[rows:]:
            assert abs(row.data[0] / 1.3 - 1.0) < 0.05
        assert again.stop() == 0
    # Both begin with what the driver reports.
    commands = [STANDING, *(message.data for message in driver.controls)]
    assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
    assert 'going on with the estimates' in again.stderr
    assert 'nobody says which v acts now' not in first.stderr + again.stderr
    samples = [row.data[topics.SIGNAL_LABELS.index('sample')] for row in driver.signals]
    assert all(later > earlier for earlier, later in pairwise(samples))


def test_each_cause_is_one_line_in_the_terminal_and_in_the_diagnostics(tmp_path: Path) -> None:
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    causes: list[tuple[type[Any] | None, QoSProfile | int, str]] = [
        (Float32, 10, 'plant_output is sent as Float32, Float64 is wanted: change /probe'),
        (Float64, best_effort, 'sent best effort, which does not arrive: set io.best'),
        (Float64, 10, 'nobody says which v acts now'),
        (None, 10, 'no plant_output for 0.3 s: is the driver running?')]
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {'timeout.plant_output': 0.3})
        probe = world.probe()
        heard = probe.collect(topics.DIAGNOSTICS, DiagnosticArray)
        probe.collect(topics.CONTROL, Float64)  # somebody listens, as a driver does
        reference = probe.publisher(topics.REFERENCE, Float64)
        for kind, qos, line in causes:
            output = kind and probe.node.create_publisher(kind, topics.PLANT_OUTPUT, qos)
            def told(output: Any = output, kind: Any = kind, line: str = line) -> bool:
                reference.publish(Float64(data=1.0))
                if output is not None:
                    output.publish(kind(data=1.0))
                texts = [each.message for message in heard for each in message.status]
                # The third is no condition that lasts, but a word about the start.
                return line in controller.stderr and (
                    line == causes[2][-1] or any(line in text for text in texts))
            probe.wait_until(told, line)
            if output is not None:
                probe.node.destroy_publisher(output)
        assert controller.stop() == 0
    for *_, line in causes[:2] + causes[3:]:
        assert sum(line in each for each in controller.stderr.splitlines()) == 1


def test_what_a_controller_publishes_is_what_layouts_show_and_latecomers_hear(tmp_path):
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        late = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        models: list[Float64MultiArray] = []
        driver.probe.node.create_subscription(Float64MultiArray, topics.MODEL, models.append, late)
        # Nothing is commanded yet: the model is the one of the parameters.
        driver.probe.wait_until(lambda: models, 'the model')
        fields, first = {}, 0
        for dimension in models[0].layout.dim:
            fields[dimension.label] = list(models[0].data[first:first + dimension.size])
            first += dimension.size
        assert complete_model(fields)['numerator'] == Parameters({}).plant.numerator
        driver.rest()
        present = dict(driver.probe.node.get_topic_names_and_types())
        heard: dict[str, list[Any]] = {}
        for topic in {topic for topic, _, _ in PATHS}:
            (name,) = present[topic]
            heard[topic] = driver.probe.collect(topic, TYPES[name])
        driver.run_until(lambda: all(heard.values()), 'a message of each topic')
        driver.run_until_known(0.05)
        low, high = (heard[f'/{topics.watched(label)}'] for label in ('m_low', 'm_high'))
        driver.run_until(lambda: low[-1].data < 1.3 < high[-1].data, 'a band around m')
        for topic, field, index in PATHS:
            value = getattr(heard[topic][-1], field)
            assert isinstance(value if index < 0 else value[index], float), topic
        assert controller.stop() == 0
