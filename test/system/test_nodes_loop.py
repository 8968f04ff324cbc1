"""The whole loop in separate processes over real DDS: lockstep, real time, stalls, losses, bags."""

from __future__ import annotations

import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from ros_processes import NodeProcess, RosWorld, ros_world
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.tools.runs.bag import read_bag

NODES = ('recorder', 'controller', 'reference', 'plant')
SIGNAL = {label: i for i, label in enumerate(topics.SIGNAL_LABELS)}
TRUTH = {label: i for i, label in enumerate(topics.TRUTH_LABELS)}
SAME_COLUMNS = {
    topics.SIGNALS: ('y_m', 'y', 'u_d', 'v', 'u_hat', 'innovation', 'status'),
    topics.ESTIMATES: ('m', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l'),
}


def start_loop(
    world: RosWorld, parameters: dict[str, object], bag: str = '', storage: str = 'mcap',
) -> dict[str, NodeProcess]:
    """Start recorder, controller, reference and plant, none of which begins before the others."""
    # In real time the reference listens to plant_output as well.
    outputs = 2 if parameters.get('lockstep') else 3
    own: dict[str, dict[str, object]] = {
        'plant': {'wait_for_subscribers': outputs},
        'recorder': {'wait_for_publishers': True, 'bag': f"'{bag}'", 'storage': storage},
    }
    listeners = {'wait_for_subscribers': 2}
    return {
        name: world.start(name, {**parameters, **own.get(name, listeners)}) for name in NODES
    }


def stop_loop(nodes: dict[str, NodeProcess]) -> None:
    for name in reversed(NODES):
        assert nodes[name].stop() == 0, nodes[name].stderr


def read_messages(bag: Path) -> dict[str, list[tuple[int, np.ndarray]]]:
    """Stamp and data of all messages with data, by topic without leading slash."""
    messages: dict[str, list[tuple[int, np.ndarray]]] = {}
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if hasattr(message, 'data'):
                messages.setdefault(connection.topic[1:], []).append((stamp, message.data))
    return messages


@pytest.mark.parametrize(
    ('parameters', 'samples', 'storage'),
    [
        ({'estimator.law': 'lms', 'estimator.output_noise_std': 0.0}, 450, 'mcap'),
        ({'output_noise_std': 1e-4, 'output_loss': 0.1, 'seed': 5, 'truth.walk_std': 1e-3,
          'truth.numerator': [1.00001e-5, 4e-5, 1e-5]}, 200, 'sqlite3'),
    ],
    ids=['lms-mcap', 'moving_horizon-losses-sqlite3'],
)
def test_lockstep_run_equals_the_simulation_in_one_process_to_the_last_bit(
    tmp_path: Path, parameters: dict[str, object], samples: int, storage: str,
) -> None:
    bag = tmp_path / 'bag'
    with ros_world(tmp_path) as world:
        nodes = start_loop(
            world, {**parameters, 'lockstep': True, 'samples': samples}, str(bag), storage
        )
        nodes['plant'].wait_for('done')
        stop_loop(nodes)
        closed = nodes['recorder'].events('closed')[0]
    run = build_closed_loop(Parameters(parameters)).run(samples)
    assert run.lost_samples == (0 if storage == 'mcap' else samples - run.samples)
    recorded = read_messages(bag)
    for topic, labels in (
        (topics.SIGNALS, topics.SIGNAL_LABELS), (topics.ESTIMATES, topics.ESTIMATE_LABELS),
    ):
        rows = np.array([data for _, data in recorded[topic]])
        assert np.array_equal(
            np.rint(run.column('t') / run.sample_period), rows[:, labels.index('sample')]
        )
        for name in SAME_COLUMNS[topic]:
            column = rows[:, labels.index(name)]
            assert np.array_equal(column, run.column(name), equal_nan=True), name
    estimates = [run.column(name)[-1] for name in ('m', 'c_r', 'c_l')]
    assert estimates == pytest.approx([1.3, 3.0, -3.0], rel=0.01)
    assert repr(read_bag(bag).record.learned) == repr(run.learned)
    assert run.learned is not None
    assert closed['missed'] == 0
    assert_complete(recorded, run.column('y'), run.column('v'), samples)
    assert closed['messages'][f'/{topics.CONTROL}'] == run.samples
    if storage == 'mcap':
        assert_mcap_reader_agrees(bag, recorded)


def assert_complete(
    recorded: dict[str, list[tuple[int, np.ndarray]]], y: np.ndarray, v: np.ndarray, samples: int,
) -> None:
    """Every output, control, reference and truth is there, stamped in simulated time."""
    assert [data for _, data in recorded[topics.PLANT_OUTPUT]] == y.tolist()
    assert [data for _, data in recorded[topics.CONTROL]] == v.tolist()
    assert len(recorded[topics.REFERENCE]) == len(y)
    assert len(recorded[topics.TRUTH]) == len(recorded[topics.APPLIED_CONTROL]) == samples
    stamps = [stamp for stamp, _ in recorded[topics.SIGNALS]]
    assert 0 <= stamps[0] <= stamps[-1] <= samples * 10_000_000


def assert_mcap_reader_agrees(
    bag: Path, recorded: dict[str, list[tuple[int, np.ndarray]]],
) -> None:
    """The independent reader finds the same samples."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for topic in (topics.PLANT_OUTPUT, topics.CONTROL):
            found = [message.data for *_, message in reader.iter_decoded_messages([f'/{topic}'])]
            assert found == [data for _, data in recorded[topic]]


def test_stalled_controller_steps_over_what_it_missed_and_still_learns(tmp_path: Path) -> None:
    # Long enough for the probe, for which nobody waits, to be discovered well before the end.
    parameters = {
        'samples': 1000, 'output_loss': 0.05, 'estimator.use_applied_control': True,
    }
    with ros_world(tmp_path) as world:
        probe = world.probe()
        signals = probe.collect(topics.SIGNALS, Float64MultiArray)
        truth = probe.collect(topics.TRUTH, Float64MultiArray)
        nodes = start_loop(world, parameters)
        probe.wait_until(lambda: len(signals) >= 100, 'the loop to run')
        nodes['controller'].send(signal.SIGSTOP)
        behind = time.monotonic() + 0.3
        probe.wait_until(lambda: time.monotonic() > behind, 'a stall of 30 samples')
        nodes['controller'].send(signal.SIGCONT)
        probe.wait_until(lambda: nodes['plant'].events('done'), 'the end of the run')
        progress = nodes['recorder'].wait_for('progress')
        stop_loop(nodes)
        progress = nodes['recorder'].events('progress')[-1]
    lost = np.diff([row.data[SIGNAL['sample']] for row in signals]) - 1
    # How many outputs of the stall wait in the middleware is left to chance; those that were never
    # published are missing in any case.
    assert lost.max() >= 1
    # An output that was never published shows only in the time stamps: without them the count of
    # the controller falls behind that of the plant. A late v is applied one sample later.
    applied = {int(row.data[TRUTH['sample']]): row.data[TRUTH['v']] for row in truth}
    in_step = [
        row.data[SIGNAL['v']] in (applied.get(sample), applied.get(sample + 1))
        for row in signals for sample in [int(row.data[SIGNAL['sample']])]
    ]
    assert np.mean(in_step[-100:]) > 0.5
    found = [progress[name] for name in ('m', 'c_r', 'c_l')]
    assert found == pytest.approx([1.3, 3.0, -3.0], rel=0.02)
    counted = re.findall(
        r'(?:samples|lost|before the first reference): (\d+)', nodes['controller'].stderr
    )
    # The recorder may be stopped before the last samples have reached it.
    assert progress['sample'] + 1 <= sum(map(int, counted)) <= 1000
