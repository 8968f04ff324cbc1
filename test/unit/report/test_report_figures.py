"""Figures of `report`: nothing covers anything else, and no curve hides another."""

import itertools
from dataclasses import replace
from math import nan

import pytest
from made_bags import PARAMETERS
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools import figures
from backlash_ros.tools.runs import figure_data


@pytest.fixture(scope='module')
def run() -> RunRecord:
    return build_closed_loop(PARAMETERS).run(120)


def texts_and_axes(figure: Figure) -> tuple[list[tuple[str, Bbox]], list[tuple[str, Bbox]]]:
    """Boxes of all texts, and of the legends and data areas."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    texts, areas = [], []
    for axes in figure.axes:
        legend = axes.get_legend()
        if legend is not None:
            texts.append(('legend', legend.get_window_extent(renderer)))
        if not axes.axison:
            continue
        areas.append((axes.get_title(loc='left'), axes.get_window_extent(renderer)))
        for text in (axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label):
            if text.get_text():
                texts.append((text.get_text(), text.get_window_extent(renderer)))
        for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            for tick in axis.get_major_ticks():
                # Ticks beyond the limits exist but are not drawn.
                if low <= tick.get_loc() <= high and tick.label1.get_visible():
                    name = f'tick {tick.label1.get_text()}'
                    texts.append((name, tick.label1.get_window_extent(renderer)))
    return texts, areas


def overlap(first: Bbox, second: Bbox) -> bool:
    """Whether two boxes share more than a rim of two pixels."""
    return bool(
        min(first.x1, second.x1) - max(first.x0, second.x0) > 2
        and min(first.y1, second.y1) - max(first.y0, second.y0) > 2
    )


@pytest.mark.parametrize('truth', [True, False])
def test_no_text_covers_another_or_the_data(run: RunRecord, truth: bool) -> None:
    rows = run.rows.copy()
    for name in ('std_m', 'std_c_r', 'std_c_l'):
        rows[:, COLUMNS.index(name)] = 0.1
    rows[40:60, COLUMNS.index('status')] = 2.0
    if not truth:
        for name in ('u', 'true_m', 'true_c_r', 'true_c_l'):
            rows[:, COLUMNS.index(name)] = nan
    shown = replace(run, rows=rows)
    parts = figure_data.interesting_parts(shown, PARAMETERS)
    late = shown.column('y_m')
    references = [figure_data.FollowedReference(late, 0.6, followed) for followed in (True, False)]
    settling = {'m': 0.5, 'c_r': None, 'c_l': 0.9}
    drawn = [
        figures.draw_estimates(shown), figures.draw_innovation(shown, parts),
        figures.draw_hysteresis(shown, parts[1]), figures.draw_input(shown, parts),
        *(figures.draw_output(shown, parts[1], reference) for reference in references),
    ]
    if truth:
        traces = figure_data.compare_laws(shown, PARAMETERS)
        drawn += [
            figures.draw_parameter_errors(shown, parts[0], settling),
            figures.draw_control_error(shown, parts), figures.draw_laws(traces, parts[0]),
        ]
    for figure in drawn:
        texts, areas = texts_and_axes(figure)
        for (one, box), (other, second) in itertools.combinations(texts, 2):
            assert not overlap(box, second), f'{one!r} and {other!r} overlap'
        for (one, box), (title, area) in itertools.product(texts, areas):
            assert not overlap(box, area), f'{one!r} covers data of {title!r}'


def test_law_that_breaks_off_does_not_take_the_report_with_it(run: RunRecord) -> None:
    other = PARAMETERS.replaced({'waveform': 'file', 'file': 'gone.csv'})
    own, *others = figure_data.compare_laws(run, other)
    assert own.recorded
    assert len(own.t) == run.samples
    assert all('gone.csv' in trace.note for trace in others)
    part = figure_data.Part('Begin', slice(10))
    assert isinstance(figures.draw_laws([own, *others], part), Figure)
