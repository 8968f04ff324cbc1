"""The recorder as a process: killed, stopped, out of room; and what can still be had of its bag."""

import os
import re
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from places import ROOT
from ros_processes import NodeProcess, Probe, RosWorld, ros_world, wait_until
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64, Float64MultiArray
from waiting import DEADLINE_S

from backlash_ros import topics
from backlash_ros.bags import BagError, BagReader, damage, message_files
from backlash_ros.tools import report
from backlash_ros.tools.runs.read_run import read_bag

NODES = ('recorder', 'controller', 'reference', 'plant')
SAMPLE = topics.SIGNAL_LABELS.index('sample')


def start_loop(world: RosWorld, bag: Path, storage: str) -> dict[str, NodeProcess]:
    own: dict[str, dict[str, object]] = {
        'recorder': {'wait_for_publishers': True, 'bag': f"'{bag}'", 'storage': storage},
        'plant': {'wait_for_subscribers': 3}}
    return {name: world.start(name, own.get(name, {'wait_for_subscribers': 2})) for name in NODES}


def recorded_samples(bag: Path) -> set[int]:
    with AnyReader([bag]) as reader:
        return {
            int(reader.deserialize(raw, connection.msgtype).data[SAMPLE])
            for connection, _, raw in reader.messages()
            if connection.topic == f'/{topics.SIGNALS}'}


def count_signals(bag: Path) -> int:
    try:
        messages = BagReader(bag).messages()
    except BagError:  # not there yet
        return 0
    return sum(topic.name == f'/{topics.SIGNALS}' for topic, _, _ in messages)


def go_on(probe: Probe, heard: list[Float64MultiArray], further: int) -> None:
    wanted = len(heard) + further
    probe.wait_until(lambda: len(heard) >= wanted, 'further samples')


def recorder(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, '-m', 'backlash_ros.nodes.recorder', *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True)


@pytest.mark.usefixtures('undrawn')
def test_killed_recorder_loses_nothing_that_it_has_flushed(tmp_path, capsys):
    bag = tmp_path / 'bag'
    with ros_world(tmp_path) as world:
        probe = world.probe()
        heard = probe.collect(topics.SIGNALS, Float64MultiArray)
        nodes = start_loop(world, bag, 'mcap')
        probe.wait_until(lambda: count_signals(bag) > 60, 'samples that must stay')
        flushed = count_signals(bag)
        nodes['recorder'].send(signal.SIGKILL)
        nodes['recorder'].wait()
        go_on(probe, heard, 20)
        assert all(nodes[name].stop() == 0 for name in ('plant', 'reference', 'controller'))
    cure = f'ros2 run backlash_ros recorder --repair {bag}'
    remains = read_bag(bag)
    told = remains.notes[0]
    assert told.startswith(f'{bag} was never closed: this is what is left, ')
    assert cure in told
    assert report.main([str(bag), '--out', str(tmp_path / 'out')]) == 0
    assert capsys.readouterr().err.startswith(f'report: warning: {told}\n')
    assert cure in (tmp_path / 'out' / 'report.html').read_text()
    done = recorder('--repair', bag)
    assert done.returncode == 0, done.stderr
    assert re.search(rf'/{topics.SIGNALS} +\d\d+ messages\n', done.stdout)
    assert f'the original is kept: {bag}.damaged\n' in done.stdout
    assert damage(bag) == ''
    kept = recorded_samples(bag)
    assert len(kept) >= flushed > 60
    repaired = read_bag(bag)
    assert not any('closed' in note for note in repaired.notes)
    np.testing.assert_array_equal(repaired.record.rows, remains.record.rows)
    with next(bag.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages([f'/{topics.SIGNALS}'])
        assert {int(message.data[SAMPLE]) for *_, message in found} == kept


def test_a_bag_is_read_while_it_is_recorded_and_complete_after_a_signal_amid_a_flood(tmp_path):
    bag = tmp_path / 'bag'
    with ros_world(tmp_path) as world:
        probe = world.probe()
        nodes = start_loop(world, bag, 'mcap')
        probe.wait_until(lambda: count_signals(bag) > 50, 'samples in the bag')
        found = read_bag(bag)
        assert 'was never closed' in found.notes[0]
        assert found.record.samples > 50
        refused = recorder('--repair', bag)
        assert (refused.returncode, refused.stderr) == (
            1, f'recorder: {bag}: is being recorded: stop its recorder first\n')
        flood = probe.publisher(topics.REFERENCE, Float64)
        probe.wait_until(flood.get_subscription_count, 'the recorder')
        def pour() -> None:
            for _ in range(100):
                flood.publish(Float64(data=1.0))
        (file,) = message_files(bag)
        size = file.stat().st_size
        wait_until(lambda: file.stat().st_size > size + 100_000, 'messages in the bag', pour)
        node = nodes['recorder']
        node.send(signal.SIGTERM)
        wait_until(lambda: node.process.poll() is not None, 'the end of the recorder', pour)
        assert node.wait() == 0, node.stderr
        counts = node.events('closed')[0]['messages']
        assert all(nodes[name].stop() == 0 for name in ('plant', 'reference', 'controller'))
    assert damage(bag) == ''
    values = [data for topic, _, data in BagReader(bag).messages()
              if topic.name == f'/{topics.REFERENCE}']
    assert len(values) == counts[f'/{topics.REFERENCE}'] > 100


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_repair_which_says_so(tmp_path: Path, number: signal.Signals) -> None:
    bag = tmp_path / 'bag'
    bag.mkdir()
    os.mkfifo(bag / 'bag.mcap')  # reading it takes as long as it is open here
    command = [sys.executable, '-m', 'backlash_ros.nodes.recorder', '--repair', str(bag)]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process, \
            (bag / 'bag.mcap').open('wb'):
        process.send_signal(number)
        said = process.communicate(timeout=DEADLINE_S)[1]
    assert (process.returncode, said) == (1, f'recorder: interrupted, nothing of {bag} is lost\n')
    assert list(tmp_path.iterdir()) == [bag]


def test_full_disk_stops_the_recording_and_nothing_else(tmp_path: Path) -> None:
    bag = tmp_path / 'bag'
    with ros_world(tmp_path) as world:
        probe = world.probe()
        heard = probe.collect(topics.SIGNALS, Float64MultiArray)
        diagnostics = probe.collect(topics.DIAGNOSTICS, DiagnosticArray)
        nodes = start_loop(world, bag, 'sqlite3')
        def recorded() -> int:
            told = nodes['recorder'].events('progress')
            return int(told[-1]['received'][topics.SIGNALS]) if told else 0
        probe.wait_until(lambda: recorded() > 60, 'a recording')
        # As a file system does that is full: what goes beyond is refused.
        size = max(path.stat().st_size for path in bag.iterdir())
        limit = (size + 20_000,) * 2
        resource.prlimit(nodes['recorder'].process.pid, resource.RLIMIT_FSIZE, limit)
        reason = nodes['recorder'].wait_for('complaint')['text']
        assert f'recording to {bag} stopped: ' in reason
        saved, seconds = re.search(r'saved are (\d+) messages of (\d+\.\d) s', reason).groups()
        assert reason.endswith(f'ros2 run backlash_ros recorder --repair {bag}')
        probe.wait_until(
            lambda: any(
                status.level == DiagnosticStatus.ERROR
                and reason in [pair.value for pair in status.values]
                for message in diagnostics for status in message.status
            ), 'the error in the diagnostics')
        told = len(nodes['recorder'].events('progress'))
        go_on(probe, heard, 50)
        probe.wait_until(
            lambda: len(nodes['recorder'].events('progress')) > told, 'further progress')
        codes = {name: nodes[name].stop() for name in reversed(NODES)}
        assert codes == {'plant': 0, 'reference': 0, 'controller': 0, 'recorder': 1}
        log = nodes['recorder'].stderr
    assert log.count('stopped: ') == 1
    assert 'Traceback' not in log
    assert re.search(r'[1-9]\d* messages came after the recording had stopped', log)
    assert 0.0 < float(seconds) < 600.0  # about a second
    assert sum(1 for _ in BagReader(bag).messages()) >= int(saved) > 0
    assert read_bag(bag).record.samples > 20
    assert (recorder('--repair', bag).returncode, damage(bag)) == (0, '')
