"""Which diagnostics become a line of the log."""

from backlash_ros.core.loop.finding import AGAIN_S, LASTS_S, Finding, Level, LevelLog

WELL = Finding(Level.OK, 'learned', 'learned')
WRONG = Finding(Level.ERROR, 'model', 'the model is wrong')
WAITING = Finding(Level.WARN, 'waiting', 'waiting', lasting=True)


def lines_of(findings: list[tuple[float, Finding]]) -> list[tuple[Level, str]]:
    lines: list[tuple[Level, str]] = []
    log = LevelLog(lambda level, text: lines.append((level, text)))
    for now_s, finding in findings:
        log.take(finding, now_s)
    return lines


def test_a_change_of_level_is_one_line_and_one_when_all_is_well_again() -> None:
    findings = [(float(t), WRONG if 5 <= t < 20 else WELL) for t in range(40)]
    assert lines_of(findings) == [
        (Level.ERROR, 'the model is wrong'), (Level.OK, 'well again: learned'),
    ]


def test_what_comes_and_goes_is_told_once_per_while() -> None:
    findings = [(0.5 * n, WRONG if n % 2 else WELL) for n in range(50)]
    assert lines_of(findings) == [(Level.ERROR, 'the model is wrong')]
    slowly = [(0.1 * n, WRONG if n // 30 % 2 else WELL) for n in range(600)]
    told = lines_of(slowly)
    assert len(told) <= 2 * (60.0 / AGAIN_S + 1)
    assert {text for _, text in told} == {'the model is wrong', 'well again: learned'}


def test_what_passes_by_itself_is_told_once_it_has_lasted() -> None:
    assert lines_of([(0.0, WAITING), (LASTS_S / 2.0, WAITING), (LASTS_S, WELL)]) == []
    assert lines_of([(0.0, WAITING), (LASTS_S, WAITING)]) == [(Level.WARN, 'waiting')]


def test_trouble_that_was_not_told_is_not_told_to_be_over() -> None:
    assert lines_of([(0.0, WAITING), (1.0, WELL), (20.0, WELL)]) == []
