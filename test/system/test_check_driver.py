"""check_driver beside a driver in another process: what is wrong is told, and nothing else."""

import csv
import json
import re
import signal
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest
from drivers.made_up_driver import PERIOD_S, RATE, REACH, parameters
from rclpy.qos import QoSProfile, ReliabilityPolicy
from ros_processes import NodeProcess, RosWorld, ros_world
from std_msgs.msg import Float64
from waiting import DEADLINE_S, wait_until

# A busy machine may hold the driver up, and then the check is right to find fault with this.
OF_THE_MACHINE = {'jitter', 'lost samples'}
REMAP = ['--ros-args', '-r', 'plant_output:=/motor/plant_output']
BEHIND_THE_DRIVER = {'backlash.m': 1.3, 'backlash.c_r': 1.0, 'backlash.c_l': -0.8,
                     'output_noise_std': 5e-4}


@pytest.fixture
def world(tmp_path: Path) -> Iterator[RosWorld]:
    # JSON is YAML.
    (tmp_path / 'driver.yaml').write_text(json.dumps({'/**': {'ros__parameters': parameters()}}))
    with ros_world(tmp_path) as world:
        yield world


def start_driver(world: RosWorld) -> None:
    world.start('plant', BEHIND_THE_DRIVER, '--params-file', str(world.folder / 'driver.yaml'),
                '-r', 'applied_control:=unheard')


def start(world: RosWorld, *options: str) -> NodeProcess:
    return world.start('check_driver', None, '--config', str(world.folder / 'driver.yaml'),
                       '--duration', '6', *options)


def check(world: RosWorld, *options: str) -> tuple[int, str]:
    process = start(world, *options)
    return process.wait(), process.stdout + process.stderr


def subjects(told: str, mark: str) -> set[str]:
    return {line[2:].split('  ')[0].strip() for line in told.splitlines() if line.startswith(mark)}


# test_driver_judgement.py has what follows from the graph; here it has to be seen through ROS.
def test_what_is_wrong_in_the_graph_is_seen_and_nothing_is_judged_of_a_mixture(world: RosWorld):
    probe = world.probe()
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    first, _ = (
        probe.node.create_publisher(Float64, '/motor/plant_output', best_effort) for _ in range(2))
    waiting = start(world, '--wait', str(DEADLINE_S))
    wait_until(lambda: ' '.join(REMAP) in waiting.stdout, 'a hint')
    waiting.kill()
    process = start(world, '--duration', '1', *REMAP)
    probe.wait_until(
        lambda: first.publish(Float64(data=1.0)) or process.process.poll() is not None, 'the end')
    assert process.wait() == 1
    assert {'publisher', 'QoS'} <= subjects(process.stdout, '✗')
    assert {'rate', 'values', 'backlash'} <= subjects(process.stdout, '–')


def test_a_drive_goes_on_from_the_v_that_acts_and_ends_at_rest_or_at_once(world: RosWorld):
    start_driver(world)
    probe = world.probe()
    controls = probe.collect('control', Float64)
    first = start(world, '--drive', '--duration', '60')
    probe.wait_until(lambda: any(abs(c.data) > 2.0 for c in controls), 'a motion of v')
    first.send(signal.SIGINT)
    probe.wait_until(lambda: first.process.poll() is not None, 'the end')
    probe.wait_until(lambda: controls[-1].data == 0.0, 'v at rest')
    assert 'Traceback' not in first.stderr
    assert first.stderr.count('nobody says which v acts now') == 1
    assert 'rate' in first.stdout
    assert_within_rate(0.0, controls, RATE)
    begin = len(controls)
    again = start(world, '--drive', '--rate', '0.5', '--ros-args', '-p', 'control.initial:=-4.0')
    probe.wait_until(lambda: len(controls) > begin + 5, 'a motion')
    again.send(signal.SIGINT)
    count = len(controls)
    probe.wait_until(lambda: len(controls) > count + 10, 'the way to rest, 8 s long')
    again.send(signal.SIGINT)
    probe.wait_until(lambda: again.process.poll() is not None, 'the end')
    assert_within_rate(-4.0, controls[begin:], 0.5)
    assert re.search(r'v is held at -[0-3]\..*another signal', again.stderr)
    assert 'nobody says' not in again.stderr


def assert_within_rate(start: float, controls: list[Float64], rate: float) -> None:
    v = [start, *(control.data for control in controls)]
    assert max(abs(b - a) for a, b in pairwise(v)) <= rate * PERIOD_S * (1.0 + 1e-9)


def test_a_good_driver_passes_and_what_cannot_be_driven_is_refused_or_ended(world: RosWorld):
    start_driver(world)
    record = world.folder / 'record.csv'
    code, told = check(world, '--drive', '--save', str(record))
    wrong = subjects(told, '✗')
    assert wrong <= OF_THE_MACHINE, told
    assert code == (1 if wrong else 0)
    assert {'sign and units', 'G(z)', 'backlash'} <= subjects(told, '✓')
    with record.open(newline='') as file:
        rows = list(csv.DictReader(file))
    # However late they were on a busy machine.
    assert len(rows) >= 6.0 / PERIOD_S
    assert max(abs(float(row['v'])) for row in rows) <= REACH
    code, told = check(world, '--drive', '--output-range', '-0.5', '0.5', '--duration', '30')
    assert code == 1
    assert 'left --output-range' in told
    rival = world.probe()
    rival.publisher('control', Float64)
    code, told = check(world, '--drive')
    assert code == 2
    assert '/control is published by ' in told
    for options, word in (
        (['--drive', '--ros-args', '-p', 'control.rate_max:=.inf'], 'give --rate'),
        (['--ros-args', '-p', 'sample_priod:=0.1'], 'did you mean sample_period?'),
        (['--config', 'nowhere.yaml'], 'nowhere.yaml'),
    ):
        code, told = check(world, *options)
        assert (code, told.count('\n')) == (2, 1)
        assert word in told
