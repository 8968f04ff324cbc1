"""Whether a loop commands, and with what it begins: one small state machine.

control_loop.ControlLoop finds what happens, but for rivals, which nodes/control/rivals.py watches
out for. An event that a phase has no line for in the table changes nothing.
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

    ANSWER = 'answer'  # y and y_m are there, and which v acts, or nobody is going to say it
    # An output after a silence, a restart of the driver, or more lost samples than can be stepped
    # over; while the loop runs, a reset of the estimates or an activation as well.
    INTERRUPTION = 'interruption'
    TIMEOUT = 'timeout'  # no output for timeout.plant_output
    RIVAL = 'rival'  # another controller was first
    RIVAL_GONE = 'rival gone'


NEXT: dict[tuple[Phase, Event], Phase] = {
    (Phase.BEGINS, Event.ANSWER): Phase.RUNS,  # from the v that acts
    (Phase.BEGINS, Event.TIMEOUT): Phase.SILENT,  # with the commands of on_timeout
    (Phase.BEGINS, Event.RIVAL): Phase.STANDS_DOWN,  # the commands of the rival tell which v acts
    (Phase.RUNS, Event.INTERRUPTION): Phase.BEGINS,  # the state of the plant is unknown
    (Phase.RUNS, Event.TIMEOUT): Phase.SILENT,
    (Phase.RUNS, Event.RIVAL): Phase.STANDS_DOWN,
    (Phase.SILENT, Event.INTERRUPTION): Phase.BEGINS,  # the driver is back
    (Phase.SILENT, Event.RIVAL): Phase.STANDS_DOWN,
    (Phase.STANDS_DOWN, Event.RIVAL_GONE): Phase.BEGINS,  # from the newest v that was heard
}


def after(phase: Phase, event: Event) -> Phase:
    """The phase that follows."""
    return NEXT.get((phase, event), phase)
