"""How long bringup waits for the samples of an axis, and what it says of those that do not come."""

from pathlib import Path

import pytest

from backlash_ros.tools.bringup.plan import AxisPlan
from backlash_ros.tools.bringup.watch import LATE_DEADLINE_S, START_DEADLINE_S, AxisProgress
from backlash_ros.tools.cli import BrokenOffError
from backlash_ros.tools.config import effective_parameters


def begun(folder: Path, driver: str = '', **values: object) -> AxisProgress:
    """An axis whose run of 100 samples has just begun."""
    p = effective_parameters(None).replaced({'samples': 100, 'driver': driver, **values})
    return AxisProgress(AxisPlan('', p, folder, record=True))


def let_pass(axis: AxisProgress, seconds: float) -> None:
    axis.began -= seconds
    axis.moved -= seconds


def test_samples_of_a_driver_that_ran_before_count_from_the_first_one_heard(tmp_path):
    axis = begun(tmp_path, 'some command')
    axis.take({'sample': 5000})
    assert not axis.complete
    axis.take({'sample': 5099})
    assert axis.complete


def test_a_plant_is_complete_once_it_says_so_and_what_is_unheard_is_counted(tmp_path):
    axis = begun(tmp_path)
    axis.take({'sample': 41, 'received': {'plant_output': 42}})
    assert not axis.complete
    axis.published = {'samples': 100, 'plant_output': 42}
    assert axis.complete
    assert axis.unheard == {'samples': 58}
    axis.take({'sample': 99, 'received': {'plant_output': 42}})
    assert axis.unheard == {}


def test_a_plant_that_stands_still_is_an_error_that_names_the_last_sample(tmp_path: Path) -> None:
    axis = begun(tmp_path, lockstep=True)
    axis.take({'sample': 41})
    let_pass(axis, axis.patience - 1.0)
    axis.check_pace()
    let_pass(axis, 2.0)
    with pytest.raises(BrokenOffError, match=r'no new sample for .* after sample 41, see '):
        axis.check_pace()


def test_a_driver_that_falls_silent_is_waited_for_and_named_once(tmp_path, capsys):
    axis = begun(tmp_path, 'some command', samples=0)
    axis.take({'sample': 7})
    let_pass(axis, axis.patience + 1.0)
    for _ in range(3):
        axis.check_pace()
    assert capsys.readouterr().err.count('after sample 7, waiting for the driver') == 1
    axis.take({'sample': 8})
    let_pass(axis, axis.patience + 1.0)
    axis.check_pace()
    assert capsys.readouterr().err.count('waiting for the driver') == 1


def test_too_few_samples_are_an_error_when_the_time_is_over(tmp_path: Path) -> None:
    axis = begun(tmp_path, 'some command')
    for sample in (7, 48):
        axis.take({'sample': sample})
    axis.began -= 1.0 + LATE_DEADLINE_S - 0.5
    axis.check_pace()
    axis.began -= 1.0
    with pytest.raises(BrokenOffError, match=r'^only 42 of 100 samples, '):
        axis.check_pace()


def test_a_driver_without_a_first_sample_is_an_error_unless_somebody_else_starts_it(tmp_path):
    for driver in ('some command', 'none'):
        axis = begun(tmp_path, driver)
        let_pass(axis, START_DEADLINE_S - 1.0)
        axis.check_pace()
        let_pass(axis, 2.0)
        if driver == 'none':
            axis.check_pace()
        else:
            with pytest.raises(BrokenOffError, match='does the driver publish its output'):
                axis.check_pace()
