"""replay from a bag whose driver says which v it applied: the estimates of the run once more."""

from pathlib import Path

import numpy as np
import pytest
from made_bags import MULTI_ARRAY, TYPES, multi_array
from rosbags.rosbag2 import StoragePlugin, Writer

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant, build_reference
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, row_of
from backlash_ros.tools.config import write_config
from backlash_ros.tools.replay import main
from backlash_ros.tools.runs.read_run import read_run

FLOAT = 'std_msgs/msg/Float64'
START_NS, PERIOD_NS = 1_800_000_000_000_000_000, 10_000_000
SAMPLES, LIMIT = 200, 4.0
LABELS = {topics.SIGNALS: topics.SIGNAL_LABELS, topics.ESTIMATES: topics.ESTIMATE_LABELS}
LOST = {60, 61, 150}  # outputs that never reach the controller
GIVEN = {'plant.uncertainty': 0.0, 'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3}


class LimitingDriver:
    """A loop as the controller node runs it, beside a driver that applies v within ±reach.

    Everything is punctual, and each report leaves just before the y that its v led to. origin: of
    the encoder that they come from.
    """

    def __init__(self, p: Parameters, reach: float, origin: float = 0.0) -> None:
        self.messages: list[tuple[int, str, float]] = []  # stamp [ns], topic, value
        self._p, self._reach, self._origin = p, reach, origin
        self._rows: list[tuple[float, ...]] = []

    def run(self) -> RunRecord:
        p, now_ns = self._p, START_NS
        plant, reference = build_plant(p), build_reference(p)
        loop = ControlLoop(p, lambda v: None, Driver(lambda: now_ns), None, SampleCounter(0.01))
        applied = 0.0
        for k in range(SAMPLES):
            sampled_ns = START_NS + k * PERIOD_NS
            y = plant.measure()
            now_ns = sampled_ns + PERIOD_NS // 10
            if k:
                shown = applied + self._origin
                self.messages.append((sampled_ns - 1000, topics.APPLIED_CONTROL, shown))
                loop.take_applied(shown, sampled_ns - 1000)
            self.messages.append((sampled_ns, topics.PLANT_OUTPUT, y))
            if k not in LOST:
                self._answer(loop, Output(y, sampled_ns, sampled_ns, now_ns, k + 1),
                             reference(0.01 * k))
                applied = min(max(loop.v, -self._reach), self._reach)
            plant.step(applied)
        return RunRecord(np.array(self._rows), 0.01, len(LOST))

    def _answer(self, loop: ControlLoop, output: Output, y_m: float) -> None:
        loop.take_reference(y_m)
        step = loop.answer(output)
        assert step is not None
        loop.core.refine()
        self._rows.append(row_of(0.01 * loop.counter.index, step.y, step.v, np.nan, step,
                                 loop.core.estimator))

    def write(self, folder: Path, run: RunRecord, without: str = '') -> Path:
        """The folder of a run with its bag; without: a topic that was not recorded."""
        write_config(self._p, folder / 'parameters.yaml')
        sent = [(at, topic, float_message(value)) for at, topic, value in self.messages]
        for row in run.rows.tolist():
            known = dict(zip(COLUMNS, row, strict=True))
            known['sample'] = round(known['t'] / 0.01)
            sent += [
                (START_NS + known['sample'] * PERIOD_NS + 10**6, topic,
                 multi_array(labels, [known.get(label, np.nan) for label in labels]))
                for topic, labels in LABELS.items()
            ]
        with Writer(folder / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            connections = {
                topic: writer.add_connection(
                    f'/{topic}', MULTI_ARRAY if topic in LABELS else FLOAT, typestore=TYPES
                ) for topic in {topic for _, topic, _ in sent} - {without}
            }
            for stamp_ns, topic, raw in sorted(sent):
                if topic != without:
                    writer.write(connections[topic], stamp_ns, raw)
        return folder


def float_message(value: float) -> bytes:
    return bytes(TYPES.serialize_cdr(TYPES.types[FLOAT](data=value), FLOAT))


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize(('use', 'reach', 'origin'), [
    ('true', LIMIT, 0.0), ('auto', LIMIT, 0.0), ('auto', np.inf, 0.0), ('auto', np.inf, 0.5),
])
def test_the_estimates_of_the_run_come_out_to_the_last_bit(tmp_path, capsys, use, reach, origin):
    p = Parameters({**GIVEN, 'estimator.use_applied_control': use})
    driver = LimitingDriver(p, reach, origin)
    run = driver.run()
    folder = driver.write(tmp_path, run)
    source = read_run(folder)
    assert source.record.column('t') == pytest.approx(run.column('t'))
    assert source.record.lost_samples == len(LOST)
    assert main([str(folder), '--out', str(tmp_path / 'out')]) == 0
    told = capsys.readouterr()
    assert 'to the last bit' in told.out
    assert told.err.count('warning') == told.err.count('of 200 samples were lost')


@pytest.mark.usefixtures('undrawn')
def test_without_its_reports_a_limiting_driver_is_learned_wrongly(tmp_path, capsys):
    driver = LimitingDriver(Parameters({**GIVEN, 'estimator.use_applied_control': True}), LIMIT)
    run = driver.run()
    assert run.column('c_r')[-1] == pytest.approx(3.0, rel=0.01)
    folder = driver.write(tmp_path, run, without=topics.APPLIED_CONTROL)
    assert main([str(folder), '--out', str(tmp_path / 'out')]) == 0
    told = capsys.readouterr()
    assert 'holds no applied_control: v is that of control' in told.err
    assert 'part from those of the run' in told.out
