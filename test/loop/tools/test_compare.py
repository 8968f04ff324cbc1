"""`compare`: one command runs every loop and writes the figure and the document."""


import pytest

from backlash_ros.core.parameters import Parameters
from backlash_ros.tools.compare import COMPARISON_HEADER, compare, contenders, main


def test_document_and_figure_come_from_one_command(tmp_path, capsys):
    assert main(['--out', str(tmp_path), '--duration', '2.5']) == 0
    page = (tmp_path / 'comparison.md').read_text()
    assert (tmp_path / 'images' / 'comparison.png').read_bytes().startswith(b'\x89PNG')
    assert '](images/comparison.png)' in page
    printed = capsys.readouterr().out
    for name in contenders(Parameters()):
        assert f'| {name} |' in page
        assert name in printed


def test_bad_input_ends_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert (main(['--set', 'amplitud=3']), capsys.readouterr().err.count('\n')) == (2, 1)


def test_learned_backlash_costs_less_than_an_uncompensated_one() -> None:
    merits = {
        result.name: dict(zip(COMPARISON_HEADER[1:], result.merits, strict=True))
        for result in compare(Parameters(), 400)
    }
    learned, plain = merits['moving_horizon, tracking'], merits['no compensation, tracking']
    assert merits['no backlash, tracking']['backlash penalty'] == 0.0
    assert plain['backlash penalty'] > 0.0
    assert learned['control error'] < 0.01 * plain['control error']
