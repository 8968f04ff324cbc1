"""`report`: what a page holds, from simulations, bags, logs; restarts, several axes, a span."""

import base64
import json
import re
import shutil
from dataclasses import dataclass
from math import nan
from pathlib import Path

import made_bags
import numpy as np
import pytest
from matplotlib.figure import Figure
from rosbags.rosbag2 import StoragePlugin

from backlash_ros import topics
from backlash_ros.core import Parameters, build_closed_loop
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord, delayed_reference
from backlash_ros.tools import figures
from backlash_ros.tools import replay as replay
from backlash_ros.tools import report as report
from backlash_ros.tools.cli import Span
from backlash_ros.tools.config import write_config
from backlash_ros.tools.records.reading import read_record
from backlash_ros.tools.runs.files import Run
from backlash_ros.tools.runs.read_run import read_bag, read_run
from backlash_ros.tools.runs.summary import compare_laws, moving_rms, reference_delay, summarise


@pytest.fixture(scope='module')
def run() -> RunRecord:
    return build_closed_loop(made_bags.PARAMETERS).run(120)


@pytest.fixture(scope='module')
def page(run: RunRecord, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp('report')
    made_bags.write_bag(out / 'bag', run, lost=frozenset({60}))
    write_config(made_bags.PARAMETERS, out / 'parameters.yaml')
    report.write_report(read_run(out), out)
    return out / 'report.html'


def test_page_needs_nothing_from_elsewhere(page: Path) -> None:
    html = re.sub('base64,[^"]+', 'base64,', page.read_text(encoding='utf-8'))
    sources = re.findall(r'(?:src|href|url|srcset|action)\s*[=(]\s*["\']?([^"\'>\s)]+)', html)
    assert sources
    assert all(source.startswith('data:image/png;base64,') for source in sources)
    assert not re.search(r'https?:|//www|<script|<link|<iframe|@import', html)


def test_page_holds_the_pictures_that_lie_beside_it(page: Path) -> None:
    html = page.read_text(encoding='utf-8')
    beside = {path.name: path.read_bytes() for path in page.parent.glob('*.png')}
    shown = [base64.b64decode(data) for data in re.findall(r'base64,([^"]+)"', html)]
    assert sorted(shown) == sorted(beside.values())
    assert set(beside) == {
        'parameter_errors.png', 'estimates.png', 'control_error.png', 'laws.png',
        'hysteresis.png', 'output.png', 'input.png'}


@pytest.mark.parametrize('models', [{}, {5: made_bags.believed([1.0, -0.5])}])
def test_bag_without_a_whole_model_is_read_all_the_same(run, tmp_path, models):
    bag = made_bags.write_bag(tmp_path / 'bag', run, models=models)
    found = read_bag(bag, run.sample_period).record
    assert found.samples == run.samples
    assert found.learned is None
    assert summarise(found, None)['model'] is None


@pytest.mark.parametrize('storage', [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_bag_gives_back_the_run(tmp_path: Path, storage: StoragePlugin) -> None:
    p = made_bags.PARAMETERS.replaced({'backlash.rate': [0.1, 0.2, -0.3]})
    worn = build_closed_loop(p).run(40)
    found = read_bag(made_bags.write_bag(tmp_path / 'bag', worn, storage), worn.sample_period)
    expected = worn.rows.copy()
    # The last v was never applied: no u, and the truth of the sample before.
    expected[-1, COLUMNS.index('u')] = nan
    expected[-1, COLUMNS.index('true_m'):] = expected[-2, COLUMNS.index('true_m'):]
    expected[:, COLUMNS.index('latency_s')] = made_bags.LATENCY_S
    np.testing.assert_array_equal(found.record.rows, expected)
    assert found.record.has_truth
    assert (found.record.lost_samples, found.notes) == (0, ())


def test_sample_without_its_estimates_is_counted(run: RunRecord, tmp_path: Path) -> None:
    bag = made_bags.write_bag(tmp_path / 'bag', run, unpaired=frozenset({50, 119}))
    found = read_bag(bag, run.sample_period)
    assert (found.record.lost_samples, found.record.samples) == (0, 118)
    assert found.notes[0].startswith('2 samples were left out')


@pytest.mark.usefixtures('undrawn')
def test_report_without_truth_shows_estimates_and_innovation(run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made_bags.write_bag(tmp_path / 'bag', run, truth=False)
    assert report.main(['bag']) == 0
    out = tmp_path / 'results' / 'latest'
    assert {path.name for path in out.glob('*.png')} == {
        'estimates.png', 'innovation.png', 'hysteresis.png', 'output.png', 'input.png'}
    html = (out / 'report.html').read_text(encoding='utf-8')
    assert 'no truth was recorded' in html
    assert 'no parameters were given' in html
    assert json.loads((out / 'summary.json').read_text())['estimator'] is None
    assert capsys.readouterr().out.strip().endswith('report.html')


def broken_bag(path: Path, run: RunRecord) -> None:
    made_bags.write_bag(path, run)
    [data] = path.glob('*.mcap')
    data.write_bytes(data.read_bytes()[:300])


def other_bag(path: Path, run: RunRecord) -> None:
    made_bags.write_messages(path, [(1, 'chatter', made_bags.FLOAT, made_bags.float_message(0.0))])


@pytest.mark.parametrize(('make', 'message'), [
    (None, 'does not exist'), (broken_bag, 'is damaged, and nothing of it can be read'),
    (other_bag, 'holds no message of controller/signals; its topics are /chatter'),
    (lambda path, run: made_bags.write_bag(path, RunRecord(run.rows[:0], run.sample_period)),
     'holds no message of controller/signals'),
    (lambda path, run: path.mkdir(), 'or the folder of one run of bringup or simulate'),
    (lambda path, run: path.touch(), 'holds no table: give rows of numbers'),
])
def test_unusable_input_leaves_a_line_alone(run, tmp_path, monkeypatch, capsys, make, message):
    monkeypatch.chdir(tmp_path)
    if callable(make):
        make(tmp_path / 'bag', run)
    assert report.main(['bag']) == 2
    err = capsys.readouterr().err
    assert err.startswith('report: ')
    assert message in err
    assert err.count('\n') == 1
    assert not (tmp_path / 'results').exists()


@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize(('lost', 'meant', 'said'), [(1, 0.0, 0), (3, 0.0, 1), (3, 0.1, 0)])
def test_many_lost_samples_are_named_unless_they_were_asked_for(
    run, tmp_path, capsys, lost, meant, said,
):
    of_losses = RunRecord(run.rows, run.sample_period, lost)
    p = made_bags.PARAMETERS.replaced({'output_loss': meant})
    report.write_report(Run(of_losses, p), tmp_path)
    assert capsys.readouterr().err.count(f'{lost} of {120 + lost} samples were lost') == said


@pytest.mark.usefixtures('undrawn')
def test_run_of_one_sample_has_a_report(tmp_path: Path) -> None:
    run = build_closed_loop(made_bags.PARAMETERS).run(1)
    assert report.write_report(Run(run, made_bags.PARAMETERS), tmp_path)['samples'] == 1
    assert (tmp_path / 'report.html').is_file()


def test_output_is_compared_with_the_reference_as_late_as_the_structure_makes_it() -> None:
    tracking = Parameters({'structure': 'tracking', 'amplitude': 0.2, 'tracking.preview': 60})
    run = build_closed_loop(tracking).run(300)
    assert reference_delay(tracking) == 60
    y_m = delayed_reference(run, reference_delay(tracking))
    np.testing.assert_array_equal(y_m[60:], run.column('y_m')[:-60])
    late, prompt = (summarise(run, known)['tracking_error_rms'] for known in (tracking, None))
    assert late < 0.5 < prompt


def test_moving_rms_is_that_of_the_newest_samples() -> None:
    values = np.array([3.0, nan, 4.0, 1e-9, 0.0, 1e-9])
    small = 1e-9 / np.sqrt(2)
    expected = [3.0, 3.0, 4.0, np.sqrt(8.0), small, small]
    np.testing.assert_allclose(moving_rms(values, 0.25), expected, rtol=1e-9)


def test_law_that_breaks_off_does_not_take_the_report_with_it(run: RunRecord) -> None:
    other = made_bags.PARAMETERS.replaced({'waveform': 'file', 'file': 'gone.csv'})
    runs, notes = compare_laws(run, other)
    assert [each.samples for each in runs.values()] == [run.samples]
    assert notes
    assert all('gone.csv' in note for note in notes)
    assert isinstance(figures.draw_error_curves(runs), Figure)


@pytest.mark.parametrize('storage', StoragePlugin)
def test_a_lone_file_of_a_bag_is_a_bag(tmp_path, run, storage):
    bag = made_bags.write_bag(tmp_path / 'bag', run, storage)
    (file,) = (file for file in bag.iterdir() if file.suffix in ('.mcap', '.db3'))
    lone = Path(shutil.copy(file, tmp_path / f'sent{file.suffix}'))
    write_config(made_bags.PARAMETERS, tmp_path / 'parameters.yaml')
    found = read_run(lone)
    assert found.notes == ()
    assert found.parameters == made_bags.PARAMETERS
    np.testing.assert_array_equal(found.record.column('y'), run.column('y'))
    np.testing.assert_array_equal(read_record(lone).y, run.column('y'))
    assert replay.main([str(lone), '--sweep', 'estimator.law=lms,fixed',
                        '--out', str(tmp_path / 'out')]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'bag', 'out', 'parameters.yaml', lone.name]


@pytest.mark.usefixtures('undrawn')
def test_a_log_is_reported_as_what_it_holds(tmp_path, capsys):
    t = 0.005 * np.arange(400)
    log = tmp_path / 'log.txt'
    log.write_text('a;b;c\n' + ''.join(
        f'{k:.3f};{np.sin(9 * k):.4f};{np.sin(9 * k - 0.1):.4f}\n' for k in t.tolist()))
    assert report.main([str(log), '--out', str(tmp_path / 'out')]) == 2
    assert 'the columns are a, b, c' in capsys.readouterr().err
    columns = ['--columns', 't=a,v=b,y=c']
    assert report.main([str(log), *columns, '--out', str(tmp_path / 'out')]) == 0
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'no controller has estimated anything' in page
    assert '400 rows, one every 5 ms' in page
    assert (tmp_path / 'out' / 'log.png').exists()


PERIOD_NS, START_NS = 10_000_000, 10**18
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
                (START_NS + int(begin_s * 1e9) + k * PERIOD_NS, name, made_bags.MULTI_ARRAY, raw)
                for k, raw in made_bags.rows_of(piece.run, labels, frozenset(), prefix, first)]
    return made_bags.write_messages(path, messages)


@pytest.fixture(scope='module')
def second() -> RunRecord:
    return build_closed_loop(OTHER).run(90)


def same(found: RunRecord, run: RunRecord) -> bool:
    names = ('y', 'v', 'm', 'status')
    return all(np.array_equal(found.column(name), run.column(name)) for name in names)


@pytest.mark.usefixtures('undrawn')
def test_bag_of_a_restart_gives_a_report_of_what_came_last_and_says_so(
    tmp_path: Path, run: RunRecord, second: RunRecord, capsys: pytest.CaptureFixture[str],
) -> None:
    bag = write_pieces(tmp_path / 'bag', Piece(run), Piece(second, begin_s=1.5, first=40))
    assert same(read_bag(bag).record, second)
    assert report.main([str(bag), '--out', str(tmp_path / 'out')]) == 0
    line = capsys.readouterr().err.splitlines()[-1]
    assert 'restarted its count: this is what follows the last restart, 1.5 s after' in line
    assert '--from and --to' in line
    assert (tmp_path / 'out' / 'report.html').is_file()


@pytest.mark.usefixtures('undrawn')
def test_from_and_to_choose_the_other_part(tmp_path, run, second, capsys):
    bag = write_pieces(tmp_path / 'bag', Piece(run), Piece(second, begin_s=1.5, first=40))
    assert same(read_bag(bag, span=Span(to_s=1.5)).record, run)
    part = read_bag(bag, span=Span(0.2, 0.7)).record
    assert np.array_equal(part.column('y'), run.column('y')[20:70])
    assert part.column('t')[0] == 0.0
    assert report.main([str(bag), '--to', '1.5', '--out', str(tmp_path / 'out')]) == 0
    assert 'restarted its count' not in capsys.readouterr().err
    assert report.main([str(bag), '--from', '9', '--out', str(tmp_path / 'none')]) == 2
    assert 'holds no sample between --from and --to' in capsys.readouterr().err
    assert report.main([str(bag), '--from', '2', '--to', '1']) == 2


@pytest.mark.usefixtures('undrawn')
def test_saved_results_are_cut_likewise(tmp_path: Path, run: RunRecord) -> None:
    report.write_report(Run(run, made_bags.PARAMETERS), tmp_path)
    part = read_run(tmp_path, span=Span(0.5, 0.8)).record
    assert np.array_equal(part.column('y'), run.column('y')[50:80])
    assert part.column('t')[0] == 0.0


@pytest.mark.parametrize('truth', [
    {'first': 179_536_708_930, 'truth_first': 17}, {'truth_early_s': 0.01},
], ids=['counts differ', 'stamped before the first signals'])
def test_truth_belongs_to_the_sample_with_its_v(tmp_path, run, truth):
    bag = write_pieces(tmp_path / 'bag', Piece(run, **truth))
    np.testing.assert_array_equal(read_bag(bag).record.column('u'), run.column('u'))


def test_bag_of_two_axes_gives_a_report_of_either(tmp_path, run, second, capsys):
    bag = write_pieces(
        tmp_path / 'bag', Piece(run, namespace='pan/'), Piece(second, namespace='tilt/'))
    assert same(read_bag(bag, axis='tilt').record, second)
    assert report.main([str(bag), '--out', str(tmp_path / 'out')]) == 0
    assert 'this is pan; --axis tilt chooses another one' in capsys.readouterr().err
    assert report.main([str(bag), '--axis', 'roll', '--out', str(tmp_path / 'none')]) == 2
    assert 'no message of controller/signals of axis roll; its topics' in capsys.readouterr().err


def test_bag_of_two_controllers_at_once_gives_a_report(tmp_path, run, second):
    bag = write_pieces(tmp_path / 'bag', Piece(run), Piece(second, begin_s=0.002, first=3))
    found = read_bag(bag)
    assert 'two controllers published at once' in found.notes[-1]
    assert found.record.samples == run.samples
