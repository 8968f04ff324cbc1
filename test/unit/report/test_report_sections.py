"""`report` of bags with more than one run: restarts, several axes, two controllers, a span."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from made_bags import MULTI_ARRAY, PARAMETERS, rows_of, write_messages

from backlash_ros import topics
from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools import report as report
from backlash_ros.tools.cli import Span
from backlash_ros.tools.runs.files import Run
from backlash_ros.tools.runs.read_run import read_bag, read_run

PERIOD_NS = 10_000_000
START_NS = 10**18
OTHER = Parameters({'estimator.law': 'lms', 'amplitude': 7.0})


@dataclass(frozen=True)
class Piece:
    """A run within a bag: its rows leave from begin_s on, its count begins with first."""

    run: RunRecord
    begin_s: float = 0.0
    first: int = 0
    namespace: str = ''
    node: str = 'controller'
    truth_first: int | None = None
    truth_early_s: float = 0.0


def write_pieces(path: Path, *pieces: Piece) -> Path:
    messages = []
    for piece in pieces:
        truth_first = piece.first if piece.truth_first is None else piece.truth_first
        for topic, labels, prefix, first, begin_s in (
            (topics.SIGNALS, topics.SIGNAL_LABELS, '', piece.first, piece.begin_s),
            (topics.ESTIMATES, topics.ESTIMATE_LABELS, '', piece.first, piece.begin_s),
            (topics.TRUTH, topics.TRUTH_LABELS, 'true_', truth_first,
             piece.begin_s - piece.truth_early_s),
        ):
            name = f'{piece.namespace}{topic.replace("controller", piece.node)}'
            messages += [
                (START_NS + int(begin_s * 1e9) + k * PERIOD_NS, name, MULTI_ARRAY, raw)
                for k, raw in rows_of(piece.run, labels, frozenset(), prefix, first)]
    return write_messages(path, messages)


@pytest.fixture(scope='module')
def first() -> RunRecord:
    return build_closed_loop(PARAMETERS).run(120)


@pytest.fixture(scope='module')
def second() -> RunRecord:
    return build_closed_loop(OTHER).run(90)


def same(found: RunRecord, run: RunRecord) -> bool:
    names = ('y', 'v', 'm', 'status')
    return all(np.array_equal(found.column(name), run.column(name)) for name in names)


@pytest.mark.usefixtures('undrawn')
def test_bag_of_a_restart_gives_a_report_of_what_came_last_and_says_so(
    tmp_path: Path, first: RunRecord, second: RunRecord, capsys: pytest.CaptureFixture[str],
) -> None:
    bag = write_pieces(tmp_path / 'bag', Piece(first), Piece(second, begin_s=1.5, first=40))
    assert same(read_bag(bag).record, second)
    assert report.main([str(bag), '--out', str(tmp_path / 'out')]) == 0
    line = capsys.readouterr().err.splitlines()[-1]
    assert 'restarted its count 1 time: this is what follows the last restart, 1.5 s after' in line
    assert '--from and --to' in line
    assert (tmp_path / 'out' / 'report.html').is_file()


@pytest.mark.usefixtures('undrawn')
def test_from_and_to_choose_the_other_part(tmp_path, first, second, capsys):
    bag = write_pieces(tmp_path / 'bag', Piece(first), Piece(second, begin_s=1.5, first=40))
    assert same(read_bag(bag, span=Span(to_s=1.5)).record, first)
    part = read_bag(bag, span=Span(0.2, 0.7)).record
    assert np.array_equal(part.column('y'), first.column('y')[20:70])
    assert part.column('t')[0] == 0.0
    assert report.main([str(bag), '--to', '1.5', '--out', str(tmp_path / 'out')]) == 0
    assert 'restarted its count' not in capsys.readouterr().err
    assert report.main([str(bag), '--from', '9', '--out', str(tmp_path / 'none')]) == 2
    assert 'holds no sample between --from and --to' in capsys.readouterr().err
    assert report.main([str(bag), '--from', '2', '--to', '1']) == 2


@pytest.mark.usefixtures('undrawn')
def test_saved_results_are_cut_likewise(tmp_path: Path, first: RunRecord) -> None:
    report.write_report(Run(first, PARAMETERS), tmp_path)
    part = read_run(tmp_path, span=Span(0.5, 0.8)).record
    assert np.array_equal(part.column('y'), first.column('y')[50:80])
    assert part.column('t')[0] == 0.0


def test_truth_belongs_to_the_sample_with_its_v_where_the_counts_differ(tmp_path, first):
    bag = write_pieces(tmp_path / 'bag', Piece(first, first=179_536_708_930, truth_first=17))
    u = read_bag(bag).record.column('u')
    assert np.array_equal(u, first.column('u'))


@pytest.mark.usefixtures('undrawn')
def test_a_truth_that_is_stamped_before_the_first_signals_is_read(tmp_path, first):
    bag = write_pieces(tmp_path / 'bag', Piece(first, truth_early_s=0.01))
    np.testing.assert_array_equal(read_bag(bag).record.column('u'), first.column('u'))


def test_bag_of_two_axes_gives_a_report_of_either(tmp_path, first, second, capsys):
    bag = write_pieces(
        tmp_path / 'bag', Piece(first, namespace='pan/'), Piece(second, namespace='tilt/')
    )
    assert same(read_bag(bag, axis='tilt').record, second)
    assert report.main([str(bag), '--out', str(tmp_path / 'out')]) == 0
    assert 'this is pan; --axis tilt chooses another one' in capsys.readouterr().err
    assert report.main([str(bag), '--axis', 'roll', '--out', str(tmp_path / 'none')]) == 2
    assert 'no message of controller/signals of axis roll; its topics' in capsys.readouterr().err


def test_bag_of_two_controllers_at_once_gives_a_report(tmp_path, first, second):
    bag = write_pieces(tmp_path / 'bag', Piece(first), Piece(second, begin_s=0.002, first=3))
    found = read_bag(bag)
    assert 'two controllers published at once' in found.notes[-1]
    assert found.record.samples == first.samples
