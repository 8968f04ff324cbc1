"""replay: the estimates of a run to the last bit, from files and bags, or where they part."""

import json
from pathlib import Path

import numpy as np
import pytest
from made_bags import FLOAT, MULTI_ARRAY, float_message, multi_array, write_messages
from matplotlib.backends.backend_agg import FigureCanvasAgg
from undrawn import leave_out

from backlash_ros import topics
from backlash_ros.core import Parameters, build_closed_loop, build_plant, build_reference
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.sample_counter import Output, SampleCounter
from backlash_ros.core.simulation.closed_loop import parting, replay
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, row_of
from backlash_ros.tools import simulate as simulate
from backlash_ros.tools.config import write_config
from backlash_ros.tools.replay import main
from backlash_ros.tools.runs.read_run import read_run

NOISY = {'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3}
# Losses, a structure that feeds y back, a learned G, a law of another kind, a limited v.
RUNS: dict[str, dict[str, object]] = {
    'paper': NOISY,
    'losses': {**NOISY, 'output_loss': 0.2},
    'tracking': {**NOISY, 'structure': 'tracking', 'amplitude': 1.0, 'frequency': 3.0},
    'learned G': {**NOISY, 'plant.uncertainty': 0.2, 'truth.scale_frequency': 1.1,
                  'structure': 'tracking', 'amplitude': 1.0, 'frequency': 3.0},
    'lms': {**NOISY, 'estimator.law': 'lms'},
    'limits': {**NOISY, 'control.min': -8.0, 'control.max': 8.0, 'control.rate_max': 60.0},
}


@pytest.mark.parametrize('name', RUNS)
def test_a_replay_with_the_own_parameters_gives_the_own_estimates(name: str) -> None:
    parameters = Parameters({'plant.uncertainty': 0.0, **RUNS[name]})
    run = build_closed_loop(parameters).run(300)
    again = replay(run, parameters)
    assert parting(run, again) is None
    assert np.array_equal(again.rows, run.rows, equal_nan=True)
    assert repr(again.learned) == repr(run.learned)  # repr, as nan differs from itself


def test_other_parameters_part_from_the_run_and_learn_from_its_v() -> None:
    parameters = Parameters({'plant.uncertainty': 0.0, **NOISY})
    run = build_closed_loop(parameters).run(300)
    again = replay(run, parameters.replaced({'plant.uncertainty': 0.1}))
    parted = parting(run, again)
    differs = again.column(parted.name) != run.column(parted.name)
    assert parted.t == run.column('t')[differs][0]
    assert parted.recorded != parted.replayed
    assert again.column('v').tolist() == run.column('v').tolist()
    assert again.column('c_r')[-1] == pytest.approx(3.0, rel=0.02)


def test_a_row_without_numbers_is_refused() -> None:
    parameters = Parameters(NOISY)
    run = build_closed_loop(parameters).run(50)
    run.rows[20, 2] = np.nan
    with pytest.raises(ValueError, match=r't=0\.2'):
        replay(run, parameters)


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('run') / 'run'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, 'print_png', leave_out)
        assert simulate.main(['--duration', '3', '--set', 'output_noise_std=1e-3',
                              '--out', str(folder)]) == 0
    return folder


@pytest.mark.usefixtures('undrawn')
def test_the_command_says_that_nothing_parts_or_where(recorded, tmp_path, capsys):
    for option in ('--set', '--sweep'):
        assert main([str(recorded), option, 'plant.uncertainty=0.1', '--out', str(tmp_path)]) == 0
        assert 'differ from those of the run from t = 0.' in capsys.readouterr().out
    assert main([str(recorded), '--out', str(tmp_path)]) == 0
    assert 'to the last bit' in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert {'replay.png', 'report.html', 'summary.json', 'samples.csv', 'record.npz'} <= names
    own, again = (json.loads((folder / 'summary.json').read_text())
                  for folder in (recorded, tmp_path))
    assert (again['final'], again['truth']) == (own['final'], own['truth'])


@pytest.mark.parametrize('arguments', [
    [], ['nowhere'], ['RUN', '--set', 'nothing=1'], ['RUN', '--set', 'x/amplitude=1'],
    ['RUN', '--sweep', 'amplitude'], ['RUN', '--from', '2', '--to', '1'],
    ['RUN', '--set', 'estimator.bounds.m=[2.0, 3.0]'], ['RUN', '--set', 'sample_period=0.1'],
])
def test_bad_input_is_told_in_one_line(recorded, tmp_path, capsys, arguments):
    given = [str(recorded) if word == 'RUN' else word for word in arguments]
    assert main([*given, '--out', str(tmp_path)]) == 2
    assert capsys.readouterr().err.count('\n') == 1


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('repeated', [1, 3])
def test_a_log_tells_what_the_controller_would_have_learned_from_it(tmp_path, capsys, repeated):
    run = build_closed_loop(Parameters({'plant.uncertainty': 0.0, **NOISY})).run(300)
    log, config = tmp_path / 'log.csv', tmp_path / 'a.yaml'
    y = run.column('y')[repeated * (np.arange(300) // repeated)]
    log.write_text('time_ms;command;position\n' + ''.join(
        f'{1e3 * t!r};{v!r};{y_k!r}\n' for t, v, y_k in zip(
            run.column('t').tolist(), run.column('v').tolist(), y.tolist(), strict=True)))
    config.write_text('/**: {ros__parameters: {plant: {uncertainty: 0.0}}}')
    assert main([str(log), '--out', str(tmp_path / 'out')]) == 2
    assert 'give --config' in capsys.readouterr().err
    assert main([str(log), '--config', str(config), '--out', str(tmp_path / 'out')]) == 0
    said = capsys.readouterr()
    assert 'states: acquiring from 0 s, tracking from' in said.out
    assert ('y repeats 3 times' in said.err) is (repeated == 3)
    final = json.loads((tmp_path / 'out' / 'summary.json').read_text())['final']
    assert final['c_r'] == pytest.approx(3.0, rel=0.02)
    assert final['c_l'] == pytest.approx(-3.0, rel=0.02)


START_NS, PERIOD_NS = 1_800_000_000_000_000_000, 10_000_000
SAMPLES, LIMIT = 200, 4.0
LABELS = {topics.SIGNALS: topics.SIGNAL_LABELS, topics.ESTIMATES: topics.ESTIMATE_LABELS}
LOST = {60, 61, 150}  # outputs that never reach the controller
GIVEN = {'plant.uncertainty': 0.0, **NOISY}


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
        loop = ControlLoop(p, Driver(lambda: now_ns), None, SampleCounter(0.01))
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
        loop.note_answer(step, output)
        loop.core.refine()
        self._rows.append(row_of(0.01 * loop.counter.index, step.y, step.v, np.nan, step,
                                 loop.core.estimator))

    def write(self, folder: Path, run: RunRecord, without: str = '') -> Path:
        write_config(self._p, folder / 'parameters.yaml')
        sent = [(at, topic, FLOAT, float_message(value)) for at, topic, value in self.messages
                if topic != without]
        for row in run.rows.tolist():
            known = dict(zip(COLUMNS, row, strict=True))
            known['sample'] = round(known['t'] / 0.01)
            sent += [(START_NS + known['sample'] * PERIOD_NS + 10**6, topic, MULTI_ARRAY,
                      multi_array({label: [known.get(label, np.nan)] for label in labels}))
                     for topic, labels in LABELS.items()]
        write_messages(folder / 'bag', sent)
        return folder


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
    assert 'differ from those of the run' in told.out
