"""bringup with real nodes: whole runs, several axes, drivers, interruptions, deaths."""

import json
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from bringup_processes import Session, bag_counts, wait_until
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from places import ROOT
from ros_processes import ros_world

from backlash_ros import topics
from backlash_ros.core.simulation.closed_loop import build_closed_loop, parting, replay
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.records.reading import read_record
from backlash_ros.tools.runs.read_run import read_run

TWO_AXES = ROOT / 'config' / 'two_axes.yaml'
BIAS = {'pan': 0.5, 'tilt': 0.25}
TRUTH = {'pan': (1.3, 3.0, -3.0), 'tilt': (0.8, 1.0, -2.0)}
PLANT = f'{shlex.quote(sys.executable)} -m backlash_ros.nodes.plant'
# Begins when controller, reference and recorder listen, so that nothing of it goes unrecorded.
PATIENT = f'{PLANT} --ros-args -p wait_for_subscribers:=3'
OF_AN_AXIS = f'{PATIENT} --params-file {TWO_AXES} -r __ns:=/{{axis}}'
CHEAP = 'estimator.law=lms'  # no fits, and no worker for them
NOISE_FREE = {'estimator.law': 'lms', 'estimator.output_noise_std': 0.0}
LOSSES = {
    'output_noise_std': 1e-4, 'output_loss': 0.1, 'truth.walk_std': 1e-3,
    'truth.numerator': [1.00001e-5, 4e-5, 1e-5],
}

# A driver that is none of this package: y follows v like a first-order lag, at 100 Hz.
FOREIGN = """
import signal, sys, rclpy
from threading import Event
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
stopping, blown = Event(), Event()
signal.signal(signal.SIGINT, lambda *_: stopping.set())
signal.signal(signal.SIGUSR1, lambda *_: blown.set())  # an exception could be lost in rclpy
node = rclpy.create_node('driver')
output = node.create_publisher(Float64, 'plant_output', 10)
state = {'v': 0.0, 'y': 0.0}
node.create_subscription(Float64, 'control', lambda m: state.update(v=m.data), 1)
def tick():
    state['y'] += 0.1 * (state['v'] - state['y'])
    output.publish(Float64(data=state['y']))
node.create_timer(0.01, tick)
while not stopping.is_set():
    rclpy.spin_once(node, timeout_sec=0.1)
    if blown.is_set():
        sys.exit('the fuse has blown')
print('last command', state['v'], flush=True)
"""


def foreign_driver(folder: Path) -> str:
    script = folder / 'driver.py'
    script.write_text(FOREIGN)
    return shlex.join([sys.executable, str(script)])


def assert_same(found: RunRecord, simulated: RunRecord) -> None:
    assert (found.samples, found.lost_samples) == (simulated.samples, simulated.lost_samples)
    for name in ('t', 'y_m', 'y', 'u_d', 'v', 'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r',
                 'innovation', 'u_hat', 'status', 'u'):
        assert np.array_equal(found.column(name), simulated.column(name), equal_nan=True), name
    assert repr(found.learned) == repr(simulated.learned)


@pytest.mark.parametrize('values', [NOISE_FREE, LOSSES], ids=['as it is', 'losses'])
def test_a_run_in_lockstep_equals_the_simulation_to_the_last_bit_and_leaves_no_process(
    start: Callable[..., Session], values: dict[str, object],
) -> None:
    samples, storage = 200, 'mcap' if values is NOISE_FREE else 'sqlite3'
    settings = [f'{name}={value}' for name, value in {**values, 'storage': storage}.items()]
    session = start(
        '--lockstep', '--duration', str(0.01 * samples), '--seed', '5',
        *(part for each in settings for part in ('--set', each)))
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    simulated = build_closed_loop(read_configuration(None, settings, 5).parameters()).run(samples)
    bag = session.out / 'bag'
    source = read_run(bag)
    assert_same(source.record, simulated)
    assert parting(source.record, replay(source.record, source.parameters)) is None
    record, rows = read_record(session.out), np.round(simulated.column('t') / 0.01).astype(int)
    assert record.v[rows].tolist() == simulated.column('v').tolist()
    assert record.y[rows].tolist() == simulated.column('y').tolist()
    assert record.lost == len(record.y) - len(rows)
    counts = bag_counts(bag)
    for topic in (topics.PLANT_OUTPUT, topics.REFERENCE, topics.CONTROL, topics.SIGNALS):
        assert counts[topic] == simulated.samples
    assert counts[topics.TRUTH] == counts[topics.APPLIED_CONTROL] == samples
    summary = json.loads((session.out / 'summary.json').read_text())
    assert (summary['samples'], summary['lost_samples']) == (
        simulated.samples, samples - simulated.samples)
    assert {path.stem for path in (session.out / 'logs').glob('*.log')} >= {
        'controller', 'plant', 'recorder', 'reference'}
    effective = yaml.safe_load((session.out / 'parameters.yaml').read_text())
    parameters = effective['/**']['ros__parameters']
    assert (parameters['seed'], parameters['lockstep'], parameters['samples']) == (5, True, samples)
    if storage == 'mcap':
        assert str(session.out / 'report.html') in session.stdout
        assert (session.out / 'report.html').is_file()
        # A reader that is none of this package nor of rosbags finds the same.
        with next(bag.glob('*.mcap')).open('rb') as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            found = reader.iter_decoded_messages([f'/{topics.CONTROL}'])
            assert [m.data for *_, m in found] == simulated.column('v').tolist()


def test_a_killed_controller_is_named_and_stops_every_axis_and_its_driver(start):
    session = start(
        '--config', str(TWO_AXES), '--unlimited', '--driver', OF_AN_AXIS, '--duration', '100',
        '--set', 'bias=0.5', '--set', 'tilt/bias=0.25', '--set', CHEAP)
    session.wait_for_samples('pan: ')
    session.wait_for_samples('tilt: ')
    os.kill(session.node('controller', '/tilt'), signal.SIGKILL)
    assert (session.wait(), session.survivors()) == (1, {})
    assert 'tilt/controller died (killed by SIGKILL)' in session.stderr
    assert str(session.out / 'tilt' / 'logs' / 'controller.log') in session.stderr
    assert 'pan/' not in session.stderr
    for axis, truth in TRUTH.items():
        assert (session.out / axis / 'report.html').is_file()
        found = json.loads((session.out / axis / 'summary.json').read_text())
        assert found['truth']['m'] == truth[0]
        effective = yaml.safe_load((session.out / axis / 'parameters.yaml').read_text())
        assert effective['/**']['ros__parameters']['bias'] == BIAS[axis]
        # The plant in the place of the driver says so when it ends.
        assert 'samples' in (session.out / axis / 'logs' / 'driver.log').read_text()


def test_nothing_survives_a_killed_bringup_and_its_bag_is_whole(start):
    session = start('--unlimited', '--driver', f'sh -c "{PLANT}; true"', '--duration', '100')
    session.wait_for_samples()
    assert len(session.survivors()) > 4, 'bringup, its nodes, the shell and its driver'
    session.process.kill()
    assert session.wait() == -signal.SIGKILL
    wait_until(lambda: not session.survivors(), 'the guardian has stopped all')
    assert bag_counts(session.out / 'bag')[topics.PLANT_OUTPUT] > 0


def test_a_driver_that_dies_is_named_with_its_last_words_and_the_run_is_reported(start, tmp_path):
    session = start(
        '--unlimited', '--driver', foreign_driver(tmp_path), '--duration', '100', '--set', CHEAP)
    session.wait_for_samples()
    (driver,) = (
        pid for pid, command in session.survivors().items()
        if 'driver.py' in command and '--driver' not in command)
    os.kill(driver, signal.SIGUSR1)
    assert (session.wait(), session.survivors()) == (1, {})
    assert 'driver died (exit code 1)' in session.stderr
    assert f'{session.out}/logs/driver.log:\n    the fuse has blown' in session.stderr
    assert session.stderr.count('died') == 1
    assert json.loads((session.out / 'summary.json').read_text())['samples'] > 0


def test_the_last_command_of_the_controller_reaches_the_driver(start, tmp_path):
    session = start(
        '--unlimited', '--driver', foreign_driver(tmp_path), '--duration', 'inf', '--no-record',
        '--set', 'on_stop=zero', '--set', 'bias=20', '--set', CHEAP)
    session.wait_for_samples()
    session.process.send_signal(signal.SIGINT)
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert (session.out / 'logs' / 'driver.log').read_text() == 'last command 0.0\n'
    assert sorted(path.name for path in session.out.iterdir()) == ['logs', 'parameters.yaml']


def test_a_driver_elsewhere_is_awaited_and_ctrl_c_is_the_regular_end_of_an_endless_run(
    start: Callable[..., Session], tmp_path: Path,
) -> None:
    folder = tmp_path / 'elsewhere'
    folder.mkdir()
    with ros_world(folder) as world:
        session = start(
            '--unlimited', '--driver', 'none', '--duration', 'inf', '--set', CHEAP,
            variables={'ROS_DOMAIN_ID': str(world.domain)})
        wait_until(
            lambda: 'waiting for the driver' in session.stdout
            or session.process.poll() is not None, 'a word on the terminal')
        assert f'ROS_DOMAIN_ID={world.domain} ' in session.stdout, session.stderr
        plant = world.start('plant')
        session.wait_for_samples()
        session.process.send_signal(signal.SIGINT)
        assert session.wait() == 0, session.stderr
        assert session.survivors() == {}
        assert 'SIGINT ends the run' in session.stderr
        assert 'Traceback' not in session.stderr
        assert bag_counts(session.out / 'bag')[topics.PLANT_OUTPUT] > 0
        assert (session.out / 'report.html').is_file()
        assert plant.process.poll() is None
    assert json.loads((session.out / 'summary.json').read_text())['samples'] > 0


# An arm of two joints and, in the same process, who plans its motion.
ARM = """
import signal, rclpy
from math import sin
from threading import Event
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import JointState
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
stopping = Event()
signal.signal(signal.SIGINT, lambda *_: stopping.set())
node, names, k = rclpy.create_node('arm'), ['waist', 'elbow'], 0
y, v = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
states = node.create_publisher(JointState, 'robot_joint_states', 10)
motion = node.create_publisher(JointState, 'robot_joint_command', 10)
node.create_subscription(
    JointState, 'joint_commands', lambda m: v.update(zip(m.name, m.position)), 1)
def tick():
    global k
    k += 1
    y.update((name, y[name] + 0.5 * (v[name] - y[name])) for name in names)
    now = node.get_clock().now().to_msg()
    motion.publish(JointState(name=names, position=[0.5 * sin(0.05 * k), 0.3 * sin(0.05 * k)]))
    message = JointState(name=names, position=list(y.values()))
    message.header.stamp = now
    states.publish(message)
node.create_timer(0.02, tick)
while not stopping.is_set():
    rclpy.spin_once(node, timeout_sec=0.1)
"""
JOINTS = """
/**: {ros__parameters: {joints: [waist, elbow], sample_period: 0.02, proportional: {f: 0.0},
  io: {style: joint_state_topic}, control: {min: -3.0, max: 3.0, rate_max: 50.0},
  estimator: {law: fixed, initial: {m: 1.0, c_r: 0.02, c_l: -0.03}}}}
/controller: {ros__parameters: {
  waist: {plant: {numerator: [0.5], denominator: [1.0, -0.5]}},
  elbow: {plant: {numerator: [0.5], denominator: [1.0, -0.5]}}}}
"""


def test_joints_of_an_arm_have_one_controller_and_a_report_each(start, tmp_path):
    (tmp_path / 'arm.py').write_text(ARM)
    (tmp_path / 'arm.yaml').write_text(JOINTS)
    session = start(
        '--config', str(tmp_path / 'arm.yaml'), '--duration', '2', '--set',
        'elbow/estimator.initial.c_r=0.05',
        '--driver', shlex.join([sys.executable, str(tmp_path / 'arm.py')]))
    assert session.wait() == 0, session.stderr
    assert session.survivors() == {}
    assert 'waiting for a plan of motion on robot_joint_command' in session.stdout
    for joint, c_r in (('waist', 0.02), ('elbow', 0.05)):
        assert (session.out / joint / 'report.html').is_file()
        summary = json.loads((session.out / joint / 'summary.json').read_text())
        assert summary['samples'] + summary['lost_samples'] >= 100
        assert summary['final']['c_r'] == c_r
