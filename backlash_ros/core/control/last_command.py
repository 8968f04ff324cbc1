"""What becomes of v when the loop ends or y stays away: it is held, or goes to zero."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import inf

from backlash_ros.core.control.limits import Limits, Motion
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.errors import ParameterError


def last_commands(
    action: str, motion: Motion, limits: Callable[[], Limits],
) -> Iterator[float]:
    """Commands that follow after a motion, one per sample; the last one stays in force.

    action: hold (v comes to rest: no further command where any acceleration is allowed), zero or
    ramp. Both go to the v nearest to 0 within the limits as fast as the limits allow; where they
    allow any move, which ramp is refused for, that is one command.

    limits: those that hold when the next command is made.
    """
    if action == 'hold':
        while (onward := limits().stop(motion)).v != motion.v:
            motion = onward
            yield motion.v
        return
    if action == 'zero' and motion.v == limits().zero:
        yield motion.v  # said even if nothing changes
    while motion.v != limits().zero or (motion.move != 0.0 and limits().acceleration < inf):
        before, motion = motion, limits().apply(limits().zero, motion)
        if motion.v == before.v and motion.move == 0.0:
            return  # v is so large that a step at rate_max does not change it
        yield motion.v


def check_last_commands(p: Parameters) -> None:
    """Raise ParameterError for a ramp without a slope."""
    for name in ('on_stop', 'on_timeout'):
        if p[name] == 'ramp' and p.control.rate_max == inf:
            raise ParameterError(
                name, 'ramp', 'needs a finite control.rate_max', 'set it, or take hold or zero'
            )
