"""Why an estimate was wrong: the same sequence once more, without one of what may be at fault."""

from __future__ import annotations

from fault_loop.fault_sequences import Sequence, Without

REST = 'none of these: noise and motion of the loop'
CAUSES = {
    Without.ERROR_OF_G: 'G off by up to 15 %',
    Without.TOLD_NOISE: 'the noise level as told, a third or three times the true one',
    Without.WRONG_READINGS: 'readings of a sensor that failed',
    Without.EVENTS: 'interruptions, losses, changes',
}


def cause_of(seed: int) -> str:
    """The first of these without which nothing that is wrong is said to be learned."""
    for without, cause in CAUSES.items():
        found = Sequence(seed, without=without).run()
        if not (found.wrong or found.wrong_inherited or found.wrong_uncertain):
            return cause
    return REST
