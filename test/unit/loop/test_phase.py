"""The phases of a loop: the table that is read is the one that runs."""

from itertools import product

import pytest

from backlash_ros.core.loop import phase as table
from backlash_ros.core.loop.phase import NEXT, Event, Phase, after


def test_documented_table_is_the_one_that_runs() -> None:
    assert table.__doc__ is not None
    lines = [line.split('|')[1:-1] for line in table.__doc__.splitlines() if line.startswith('|')]
    rows = [[cell.strip() for cell in line] for line in lines[2:]]
    assert {(Phase(a), Event(b)): Phase(c) for a, b, c, _ in rows} == NEXT


@pytest.mark.parametrize(('phase', 'event'), list(product(Phase, Event)))
def test_a_loop_that_stands_down_is_woken_by_nothing_but_the_end_of_its_rival(phase, event):
    following = after(phase, event)
    if phase is Phase.STANDS_DOWN:
        assert (following is phase) == (event is not Event.RIVAL_GONE)
    if event is Event.RIVAL:
        assert following is Phase.STANDS_DOWN
    # Whatever ends a phase but the first answer leads back to a first command.
    if following is Phase.RUNS:
        assert phase is Phase.RUNS or event is Event.ANSWER
