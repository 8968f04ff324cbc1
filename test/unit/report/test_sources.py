"""Whatever holds a run is read: bags of any storage and compression, lone files of them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from made_bags import PARAMETERS, write_bag
from rosbags.rosbag2 import StoragePlugin

from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.config import write_config
from backlash_ros.tools.records.reading import read_record
from backlash_ros.tools.replay import command as replay
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
