"""Files and figures of a run: complete, exact, strict JSON; merits that are known."""

import json
from dataclasses import replace
from math import exp, nan
from pathlib import Path

import numpy as np
import pytest

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.simulation import run_record
from backlash_ros.tools.cli import InputError, number_of_samples
from backlash_ros.tools.runs import files as results
from backlash_ros.tools.runs.summary import summarise


def without_truth(run: run_record.RunRecord) -> run_record.RunRecord:
    rows = run.rows.copy()
    for name in ('u', 'true_m', 'true_c_r', 'true_c_l'):
        rows[:, run_record.COLUMNS.index(name)] = nan
    return run_record.RunRecord(rows, run.sample_period, run.lost_samples)


OLD_HEADER = 't,y_m,y,u_d,v,u,m,c_r,c_l,f'  # of samples.csv before version 0.3
LEARNED = dict(zip(run_record.MODEL_LABELS, (
    (0.1, 0.05), (1.0, -0.9), (1.0,), (0.1,), (0.2,), (0.3,), (0.4,), (nan,), (1.1,), (0.02,),
), strict=True))


@pytest.fixture(scope='module')
def run() -> run_record.RunRecord:
    lossy = Parameters({'output_loss': 0.1, 'estimator.law': 'lms'})
    return build_closed_loop(lossy).run(150)


def test_samples_are_written_in_full_precision_and_u_only_where_it_is_known(run, tmp_path):
    for record in (run, without_truth(run)):
        results.write_run(record, tmp_path)
        header = (tmp_path / 'samples.csv').read_text().split('\n', 1)[0].split(',')
        assert header == [*OLD_HEADER.split(','), 'std_m', 'std_c_r', 'std_c_l', 'status']
        again = results.read_samples(tmp_path / 'samples.csv', run.sample_period)
        assert again.samples == run.samples
        for name in header:
            np.testing.assert_array_equal(again.column(name), record.column(name))


def test_what_is_not_finite_becomes_null(run: run_record.RunRecord, tmp_path: Path) -> None:
    path = tmp_path / 'summary.json'
    results.write_summary({'a': nan, 'b': [1.0, float('inf')], 'c': {'d': -float('inf')}}, path)
    assert json.loads(path.read_text()) == {'a': None, 'b': [1.0, None], 'c': {'d': None}}
    results.write_summary(summarise(run, None), path)
    stored = json.loads(path.read_text())
    assert stored['final_std'] == {'m': None, 'c_r': None, 'c_l': None}
    assert stored['estimator'] is None


def test_summary_tells_the_states_by_their_share(run: run_record.RunRecord) -> None:
    rows = run.rows.copy()
    codes = rows[:, run_record.COLUMNS.index('status')]
    codes[:] = 1.0
    codes[:len(codes) // 2] = 0.0
    codes[-1] = 2.0
    summary = summarise(run_record.RunRecord(rows, 0.01), None)
    assert summary['final_status'] == 'not excited'
    share = summary['status_share']
    assert list(share) == ['acquiring', 'tracking', 'not excited', 'no data', 'inconsistent']
    assert share['acquiring'] == len(codes) // 2 / len(codes)
    assert share['not excited'] == 1 / len(codes)
    assert sum(share.values()) == pytest.approx(1.0)
    codes[:] = nan
    unknown = summarise(run_record.RunRecord(rows, 0.01), None)
    assert unknown['final_status'] is None
    assert unknown['status_share'] is None


def test_summary_and_record_tell_the_model_that_was_believed_at_the_end(run, tmp_path):
    summary = summarise(replace(run, learned=LEARNED), None)
    assert summary['model'] == {
        'numerator': [0.1, 0.05], 'denominator': [1.0, -0.9], 'delay_samples': 1}
    assert (summary['noise_ratio'], summary['unexplained']) == (1.1, 0.02)
    unknown = summarise(replace(run, learned=None), None)
    assert [unknown[name] for name in ('model', 'noise_ratio', 'unexplained')] == [None] * 3
    for learned in (LEARNED, None):
        results.write_run(replace(run, learned=learned), tmp_path)
        assert repr(results.read_record(tmp_path / 'record.npz').learned) == repr(learned)


def test_latency_is_given_in_milliseconds_without_the_unknown(run: run_record.RunRecord) -> None:
    assert summarise(run, None)['loop_latency_ms'] is None
    rows = run.rows[:4].copy()
    rows[:, run_record.COLUMNS.index('latency_s')] = 0.001, nan, 0.002, 0.003
    summary = summarise(replace(run, rows=rows), None)
    assert summary['loop_latency_ms'] == pytest.approx({'p50': 2.0, 'p99': 2.98})


@pytest.mark.parametrize(('period', 'samples'), [(0.01, 1000), (0.009996, 1000), (60.0, 100)])
def test_without_a_duration_any_sample_period_is_simulated(period: float, samples: int) -> None:
    assert number_of_samples(Parameters({'sample_period': period}), None) == samples


def test_latest_points_at_the_newest_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folders = [results.result_directory(None) for _ in range(3)]
    assert len(set(folders)) == 3
    latest = tmp_path / 'results' / 'latest'
    assert latest.is_symlink()
    assert latest.resolve() == folders[-1].resolve()
    # Relative, so that the results can be moved.
    assert str(latest.readlink()) == folders[-1].name
    latest.unlink()
    latest.mkdir()
    assert results.result_directory(None).is_dir()
    assert 'latest does not point to' in capsys.readouterr().err
    assert not list(latest.parent.glob('.latest*'))
    monkeypatch.setattr(results.os, 'access', lambda *_: False)
    with pytest.raises(InputError, match='choose another --out'):
        results.result_directory(latest)


def test_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / 'text'
    write_atomically(path, 'old')
    write_atomically(path, 'nëw')
    assert path.read_text(encoding='utf-8') == 'nëw'
    (tmp_path / 'folder' / 'full').mkdir(parents=True)
    with pytest.raises(OSError, match='folder'):
        write_atomically(tmp_path / 'folder', 'cannot replace a folder')
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ['folder', 'text']


@pytest.mark.parametrize(('text', 'message'), [
    ('', 'line 1: must be the header'), ('a,b\n1,2\n', 'line 1: must be the header'),
    (f'{OLD_HEADER}\n', 'must hold rows of 10 numbers'),
    (f'{OLD_HEADER}\n0,1\n', 'must hold rows of 10 numbers'),
    (f'{OLD_HEADER}\n0,1,1,1,1,x,1,1,1,1\n', "could not convert string to float: 'x'"),
    (f'{OLD_HEADER}\n' + '0,1,1,1,1,1,1,1,1,1\n' * 2, 'line 3: t must be finite, and rise'),
    (f'{OLD_HEADER}\n0,1,1,1,1,1,1,1,1,1\ninf,1,1,1,1,1,1,1,1,1\n', 'line 3: t must be finite'),
    (f'{OLD_HEADER}\n0,1,1,1,1,1,1,1,1,1\n', 'needs two samples'),
])
def test_mistake_in_samples_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'samples.csv'
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        results.read_samples(path)


@pytest.mark.parametrize('content', [b'', b'PK', b'nothing of the kind'])
def test_broken_record_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / 'record.npz'
    path.write_bytes(content)
    with pytest.raises(InputError, match=r'record\.npz: is not a record'):
        results.read_record(path)


T, ONES = np.arange(1000) * 0.01, np.ones(1000)


def record(samples: int = 1000, **signals: object) -> run_record.RunRecord:
    rows = np.full((samples, len(run_record.COLUMNS)), nan)
    rows[:, run_record.COLUMNS.index('t')] = T[:samples]
    for name, values in signals.items():
        rows[:, run_record.COLUMNS.index(name)] = values
    return run_record.RunRecord(rows, 0.01)


def test_settling_time_of_an_exponential_is_when_it_reaches_one_percent() -> None:
    estimate = 3.0 * (1.0 + np.exp(-T))
    assert exp(-4.61) < 0.01 < exp(-4.60)
    assert run_record.settling_time(T, estimate, 3.0 * ONES) == pytest.approx(4.61)
    assert run_record.settling_time(T, -estimate, -3.0 * ONES) == pytest.approx(4.61)


def test_run_without_samples_has_no_figures() -> None:
    nothing = record(samples=0)
    assert nothing.samples == 0
    assert not nothing.has_truth
    assert run_record.control_error_rms(nothing) is None
    assert run_record.settling_time(T[:0], ONES[:0], ONES[:0]) is None


def test_truth_is_known_only_if_it_is_known_throughout() -> None:
    assert record(true_m=1.3).has_truth
    assert not record().has_truth
    assert not record(true_m=np.where(T < 1.0, nan, 1.3)).has_truth
