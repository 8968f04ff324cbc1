"""Figures of `report`: nothing covers anything else, and no curve hides another."""


import pytest
from made_bags import PARAMETERS
from matplotlib.figure import Figure

from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools import figures
from backlash_ros.tools.runs import figure_data


@pytest.fixture(scope='module')
def run() -> RunRecord:
    return build_closed_loop(PARAMETERS).run(120)


def test_law_that_breaks_off_does_not_take_the_report_with_it(run: RunRecord) -> None:
    other = PARAMETERS.replaced({'waveform': 'file', 'file': 'gone.csv'})
    own, *others = figure_data.compare_laws(run, other)
    assert own.recorded
    assert len(own.t) == run.samples
    assert all('gone.csv' in trace.note for trace in others)
    part = figure_data.Part('Begin', slice(10))
    assert isinstance(figures.draw_laws([own, *others], part), Figure)
