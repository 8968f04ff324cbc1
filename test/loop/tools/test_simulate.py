"""`simulate`: one run, many seeds, sweeps, the same again whatever computes it; `compare`."""

import csv
import json
import os
import signal
import subprocess
import sys
from math import inf
from pathlib import Path

import numpy as np
import psutil
import pytest
from places import ROOT
from strategies import output_of, paper_example
from waiting import DEADLINE_S, wait_until

from backlash_ros.core import Parameters, build_closed_loop, build_controller
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.run_record import control_error_rms, settling_time
from backlash_ros.tools import batch
from backlash_ros.tools.batch import Outcome, statistics
from backlash_ros.tools.cli import InputError
from backlash_ros.tools.compare import COMPARISON_HEADER, compare, contenders
from backlash_ros.tools.compare import main as compare_main
from backlash_ros.tools.simulate import main

NOISY = ['--set', 'output_noise_std=1e-3', '--set', 'estimator.law=lms']


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline='') as file:
        return list(csv.DictReader(file))


def noisy(changes: dict[str, object] | None = None) -> Parameters:
    return Parameters({'output_noise_std': 1e-3, 'estimator.law': 'lms', **(changes or {})})


@pytest.fixture
def one_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, 'sched_getaffinity', lambda pid: {0}, raising=False)


def test_run_writes_its_results_and_prints_a_table(tmp_path, capsys):
    assert main(['--duration', '0.5', '--out', str(tmp_path), '--set', 'frequency=300']) == 0
    files = {path.name for path in tmp_path.iterdir()}
    assert files >= {'report.html', 'samples.csv', 'summary.json', 'parameters.yaml'}
    assert json.loads((tmp_path / 'summary.json').read_text())['samples'] == 50
    out, warned = capsys.readouterr()
    lines = out.splitlines()
    assert 'samples per period' in warned
    assert [line.split()[0] for line in lines[1:4]] == ['m', 'c_r', 'c_l']
    assert lines[-1] == f'report: {tmp_path / "report.html"}'


def test_parallel_runs_equal_serial_ones() -> None:
    jobs = batch.make_jobs(noisy({'output_loss': 0.1}), [{}], range(5, 9), 0.8)
    serial = batch.run_jobs(jobs, workers=1)
    assert repr(batch.run_jobs(jobs, workers=2)) == repr(serial)
    assert len({outcome['m'] for outcome in serial}) == len(jobs)


@pytest.mark.usefixtures('one_processor')
def test_seeds_give_a_table_and_a_row_each(tmp_path, capsys):
    arguments = [*NOISY, '--seeds', '3', '--seed', '10', '--duration', '0.7']
    assert main([*arguments, '--out', str(tmp_path)]) == 0
    rows = rows_of(tmp_path / 'seeds.csv')
    assert [row['seed'] for row in rows] == ['10', '11', '12']
    jobs = batch.make_jobs(noisy(), [{}], [10, 11, 12], 0.7)
    expected = [batch.run_job(job) for job in jobs]
    assert [float(row['c_r']) for row in rows] == [outcome['c_r'] for outcome in expected]
    out = capsys.readouterr().out
    rmse = statistics(expected)['m'][1]
    assert out.splitlines()[1].split()[:3][2] == f'{rmse:.3g}'
    assert 'not within 1 % at the end: 3 runs, seed 10, 11, 12' in out


def test_sweep_runs_every_combination_for_every_seed(tmp_path: Path) -> None:
    arguments = ['--sweep', 'output_noise_std=1e-4,1e-3', '--sweep', 'estimator.law=lms,printed',
                 '--seeds', '2', '--duration', '0.5', '--out', str(tmp_path)]
    assert main(arguments) == 0
    rows = rows_of(tmp_path / 'sweep.csv')
    assert [(row['output_noise_std'], row['estimator.law'], row['seed']) for row in rows] == [
        (noise, law, seed)
        for noise in ('0.0001', '0.001') for law in ('lms', 'printed') for seed in ('1', '2')]


@pytest.mark.parametrize(('arguments', 'message'), [
    (['--set', 'sed=1'], 'did you mean seed?'),
    (['--config', 'nothing.yaml'], 'nothing.yaml: cannot be read'),
    (['--duration', '0.015'], 'whole multiple of sample_period=0.01'),
    (['--duration', '-1'], 'must be finite and > 0'), (['--seed', '-1'], 'seed=-1'),
    (['--duration', 'x'], "invalid float value: 'x'"), (['--seeds', '0'], '--seeds=0 must be >= 1'),
    (['--sweep', 'seed=1,2', '--seeds', '2'], 'exclude each other'),
    (['--sweep', 'seed'], 'must be KEY=v1,v2,...'),
    (['--sweep', 'seed=1', '--sweep', 'seed=2'], 'names seed twice'),
    (['--sweep', 'backlash.m=1,-1'], 'backlash.m=-1.0 must be > 0'),
    (['--nonsense'], 'unrecognized arguments: --nonsense'),
])
def test_bad_input_is_a_line_and_leaves_nothing(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err
    assert err.startswith('simulate: ')
    assert (err.count('\n'), list(tmp_path.iterdir())) == (1, [])


def outcome(error: float, settling: float | None) -> Outcome:
    return {
        'm': 2.0 + error, 'c_r': 4.0, 'c_l': -4.0, 'true_m': 2.0, 'true_c_r': 4.0, 'true_c_l': -4.0,
        'settling_m': settling, 'settling_c_r': 0.0, 'settling_c_l': 0.0, 'problem': ''}


def test_statistics_are_those_of_the_errors() -> None:
    of = statistics([outcome(0.01, 1.0), outcome(-0.025, None), outcome(0.015, 2.0)])
    rmse = (9.5 / 3) ** 0.5 * 0.01
    assert of['m'] == pytest.approx((0.0, rmse, 2.0, inf, 2 / 3), abs=1e-15)
    assert of['c_r'][-1] == 1.0


def test_run_that_broke_off_is_left_out_of_the_statistics() -> None:
    of = statistics([outcome(0.01, 1.0), {'problem': 'y=inf'}])
    assert of['m'][1] == pytest.approx(0.01)
    with pytest.raises(InputError, match='every run broke off, the first one with: y=inf'):
        statistics([{'problem': 'y=inf'}])


def test_run_that_breaks_off_says_why() -> None:
    # No measurement is that large, and no reference may be.
    [job] = batch.make_jobs(noisy({'amplitude': 1e99}), [{}], [1], 1.0)
    broken = batch.run_job(job)
    assert 'must be finite' in str(broken['problem'])
    assert broken['m'] is None


@pytest.mark.parametrize(('address', 'installed', 'cure'), [
    ('tcp://127.0.0.1:1', True, 'dask scheduler'), ('nonsense://x', True, 'dask scheduler'),
    ('tcp://x:1', False, 'pip install distributed'),
])
def test_missing_cluster_is_told_in_one_line(address, installed, cure, monkeypatch, capsys):
    if installed:
        pytest.importorskip('distributed')
    else:
        monkeypatch.setitem(sys.modules, 'distributed', None)
    monkeypatch.setattr(batch, 'CLUSTER_ANSWER_S', 0.3)
    assert main(['--duration', '1', *NOISY, '--seeds', '6', '--cluster', address]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert cure in said


def is_gone(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


INTERRUPTED = """
import signal, sys

class Interrupt:
    def find_spec(name, *_):
        if name == 'numpy':
            signal.raise_signal(signal.SIGINT)

sys.argv = ['/usr/lib/simulate']
sys.meta_path.insert(0, Interrupt)
import backlash_ros.tools.simulate
print('imported')
"""


def test_an_interrupt_during_the_imports_ends_a_tool_in_one_line() -> None:
    ended = subprocess.run([sys.executable, '-c', INTERRUPTED], capture_output=True, text=True,
                           check=False, timeout=DEADLINE_S)
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, '', 'interrupted\n')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_interrupted_seeds_end_at_once_with_one_line(tmp_path: Path, number: int) -> None:
    command = [sys.executable, '-m', 'backlash_ros.tools.simulate', '--seeds', '4',
               '--duration', '100000', '--out', str(tmp_path / 'out')]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)
    try:
        # The first child only keeps track of shared resources; a worker may still be starting,
        # which is the worst moment.
        wait_until(lambda: len(psutil.Process(process.pid).children()) > 1, 'the start of a worker')
        # A terminal sends Ctrl-C to the whole group, a supervisor SIGTERM to the parent alone.
        send = os.killpg if number == signal.SIGINT else os.kill
        send(process.pid, number)
        _, err = process.communicate(timeout=DEADLINE_S)
        assert (process.returncode, err) == (1, 'simulate: interrupted\n')
        wait_until(lambda: is_gone(process.pid), 'the end of every process')
    finally:
        if not is_gone(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_document_and_figure_come_from_one_command(tmp_path, capsys):
    assert compare_main(['--out', str(tmp_path), '--duration', '2.5']) == 0
    page = (tmp_path / 'comparison.md').read_text()
    assert (tmp_path / 'images' / 'comparison.png').read_bytes().startswith(b'\x89PNG')
    assert '](images/comparison.png)' in page
    printed = capsys.readouterr().out
    for name in contenders(Parameters()):
        assert f'| {name} |' in page
        assert name in printed


@pytest.mark.parametrize('given', [['--set', 'amplitud=3'], ['--out', '/proc/nowhere']])
def test_bad_input_ends_with_one_line(given, capsys):
    assert (compare_main(['--duration', '0.1', *given]), capsys.readouterr().out) == (2, '')


def test_learned_backlash_costs_less_than_an_uncompensated_one() -> None:
    merits = {
        result.name: dict(zip(COMPARISON_HEADER[1:], result.merits, strict=True))
        for result in compare(Parameters(), 400)}
    learned, plain = merits['moving_horizon, tracking'], merits['no compensation, tracking']
    assert merits['no backlash, tracking']['backlash penalty'] == 0.0
    assert plain['backlash penalty'] > 0.0
    assert learned['control error'] < 0.01 * plain['control error']


def test_lms_learns_the_papers_backlash_to_1_percent_within_5_s() -> None:
    run = build_closed_loop(paper_example()).run(1000)
    assert max(settling_time(run.column('t'), run.column(name), run.column(f'true_{name}'))
               for name in ('m', 'c_r', 'c_l')) <= 5.0
    assert control_error_rms(run) < 1e-3


def test_row_holds_the_signals_of_one_sample() -> None:
    run = build_closed_loop(paper_example()).run(300)
    t, y_m, u_d, v, u = (run.column(name) for name in ('t', 'y_m', 'u_d', 'v', 'u'))
    np.testing.assert_allclose(t, 0.01 * np.arange(300))
    np.testing.assert_allclose(y_m, 10.0 * np.sin(12.6 * t))
    np.testing.assert_allclose(u_d, y_m + run.column('f') * v, atol=1e-9)  # (3.2)
    assert (u <= 1.3 * (v + 3.0) + 1e-9).all()
    assert (u >= 1.3 * (v - 3.0) - 1e-9).all()
    model = TransferFunction((1e-5, 4e-5, 1e-5), (1.0, -2.88504, 2.77196, -0.88692))
    np.testing.assert_allclose(run.column('y'), output_of(model, u), atol=1e-9)
    assert run.has_truth


@pytest.mark.parametrize(('law', 'structure'), [
    ('moving_horizon', 'proportional'), ('moving_horizon', 'tracking'), ('lms', 'proportional'),
    ('printed', 'proportional'), ('fixed', 'tracking'), ('gradient', 'pole_placement'),
])
@pytest.mark.parametrize('size', [5e-324, 1e-155, 1e-130])
def test_commands_whose_square_is_hardly_a_number_are_harmless(law, structure, size):
    loop = build_controller(Parameters({'estimator.law': law, 'structure': structure}))
    for k in range(200):
        y, applied = np.sin(0.05 * k), [size * (k % 15 - 7)] if k else []
        step = loop.step(y, size * (k % 20 - 10), 0, applied)
        loop.refine()
        estimate = loop.estimator.estimate
        assert np.all(np.isfinite([step.v, estimate.m, estimate.c_r, estimate.c_l]))
