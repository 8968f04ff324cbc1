"""`simulate --cluster` without what it needs: one line that names the cure."""

import sys

import pytest

from backlash_ros.tools import batch
from backlash_ros.tools.simulate import main

HERE = '127.0.0.1'
RUNS = ['--duration', '1', '--set', 'output_noise_std=1e-3', '--seeds', '6']


@pytest.mark.parametrize(('address', 'cure'), [
    (f'tcp://{HERE}:1', 'dask scheduler'), ('nonsense://x', 'dask scheduler'),
])
def test_missing_scheduler_is_told_in_one_line(address, cure, monkeypatch, capsys):
    pytest.importorskip('distributed')
    monkeypatch.setattr(batch, 'CLUSTER_ANSWER_S', 0.3)
    assert main([*RUNS, '--cluster', address]) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert f'--cluster {address}: ' in said
    assert cure in said


def test_missing_dask_is_told_with_the_cure(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert main([*RUNS, '--cluster', 'tcp://x:1']) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert "pip install 'backlash_ros[cluster]'" in said


def test_one_run_needs_no_cluster(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(['--cluster', 'tcp://x:1']) == 2
    assert '--seeds' in capsys.readouterr().err
