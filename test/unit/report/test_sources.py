"""Whatever holds a run is read: bags of any storage and compression, lone files of them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from made_bags import PARAMETERS, write_bag
from rosbags.rosbag2 import StoragePlugin

from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools import replay as replay
from backlash_ros.tools import report as report
from backlash_ros.tools.config import write_config
from backlash_ros.tools.records.reading import read_record
from backlash_ros.tools.runs.read_run import read_run


@pytest.fixture(scope='module')
def run() -> RunRecord:
    return build_closed_loop(PARAMETERS).run(60)


@pytest.mark.parametrize('storage', StoragePlugin)
def test_a_lone_file_of_a_bag_is_a_bag(tmp_path, run, storage):
    bag = write_bag(tmp_path / 'bag', run, storage)
    (file,) = (file for file in bag.iterdir() if file.suffix in ('.mcap', '.db3'))
    lone = Path(shutil.copy(file, tmp_path / f'sent{file.suffix}'))
    write_config(PARAMETERS, tmp_path / 'parameters.yaml')
    found = read_run(lone)
    assert found.notes == ()
    assert found.parameters == PARAMETERS
    np.testing.assert_array_equal(found.record.column('y'), run.column('y'))
    np.testing.assert_array_equal(read_record(lone).y, run.column('y'))
    assert replay.main([str(lone), '--sweep', 'estimator.law=lms,fixed',
                        '--out', str(tmp_path / 'out')]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'bag', 'out', 'parameters.yaml', lone.name,
    ]


@pytest.mark.usefixtures('undrawn')
def test_a_log_is_reported_as_what_it_holds(tmp_path, capsys):
    t = 0.005 * np.arange(400)
    log = tmp_path / 'log.txt'
    log.write_text('a;b;c\n' + ''.join(
        f'{k:.3f};{np.sin(9 * k):.4f};{np.sin(9 * k - 0.1):.4f}\n' for k in t.tolist()))
    assert report.main([str(log), '--out', str(tmp_path / 'out')]) == 2
    assert 'the columns are a, b, c' in capsys.readouterr().err
    given = [str(log), '--columns', 't=a,v=b,y=c', '--out', str(tmp_path / 'out')]
    assert report.main(given) == 0
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'no controller has estimated anything' in page
    assert '400 rows, one every 5 ms' in page
    assert (tmp_path / 'out' / 'log.png').exists()
