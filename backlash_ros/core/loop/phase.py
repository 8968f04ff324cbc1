"""Whether a loop commands, and with what it begins: one small state machine.

| phase | event | next phase | what is done |
|---|---|---|---|
| begins | answer | runs | the first command goes on from the v that acts |
| begins | timeout | silent | a new core, and the commands of on_timeout |
| begins | rival | stands down | nothing is sent; its commands tell which v acts |
| runs | interruption | begins | a new core: the state of the plant is unknown |
| runs | timeout | silent | a new core, and the commands of on_timeout |
| runs | rival | stands down | nothing is sent; its commands tell which v acts |
| silent | interruption | begins | the driver is back: a new core |
| silent | rival | stands down | nothing is sent; its commands tell which v acts |
| stands down | rival gone | begins | a new core, from the newest v that was heard |

An event that a phase has no line for changes nothing. control_loop.ControlLoop finds what happens,
but for rivals, which nodes/control/rivals.py watches out for. `answer`: an output has come with y
and y_m, and it is known which v acts, or nobody is going to say so. `interruption`: an output after
a silence, after a restart of the driver, or after more lost samples than can be stepped over; where
the loop runs, a reset of the estimates or an activation is one as well. `timeout`: no output for
timeout.plant_output. `rival`: another controller was first.
"""

from __future__ import annotations

from enum import Enum


class Phase(Enum):
    """Where a loop stands."""

    BEGINS = 'begins'
    RUNS = 'runs'
    SILENT = 'silent'
    STANDS_DOWN = 'stands down'


class Event(Enum):
    """What happens to a loop."""

    ANSWER = 'answer'
    INTERRUPTION = 'interruption'
    TIMEOUT = 'timeout'
    RIVAL = 'rival'
    RIVAL_GONE = 'rival gone'


NEXT: dict[tuple[Phase, Event], Phase] = {
    (Phase.BEGINS, Event.ANSWER): Phase.RUNS,
    (Phase.BEGINS, Event.TIMEOUT): Phase.SILENT,
    (Phase.BEGINS, Event.RIVAL): Phase.STANDS_DOWN,
    (Phase.RUNS, Event.INTERRUPTION): Phase.BEGINS,
    (Phase.RUNS, Event.TIMEOUT): Phase.SILENT,
    (Phase.RUNS, Event.RIVAL): Phase.STANDS_DOWN,
    (Phase.SILENT, Event.INTERRUPTION): Phase.BEGINS,
    (Phase.SILENT, Event.RIVAL): Phase.STANDS_DOWN,
    (Phase.STANDS_DOWN, Event.RIVAL_GONE): Phase.BEGINS,
}


def after(phase: Phase, event: Event) -> Phase:
    """The phase that follows."""
    return NEXT.get((phase, event), phase)
