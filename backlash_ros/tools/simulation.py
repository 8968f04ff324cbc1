"""One simulated run, and what becomes of one that breaks off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from backlash_ros.core.closed_loop import ClosedLoop, build_closed_loop
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.run_record import RunRecord
from backlash_ros.tools.errors import BrokenOffError


def prepare(parameters: Parameters) -> ClosedLoop:
    """The closed loop, with the file of `waveform: file` read; raises what is wrong with it."""
    return build_closed_loop(parameters)


def run_loop(
    loop: ClosedLoop, samples: int, on_sample: Callable[[int], None] | None = None,
) -> RunRecord:
    """Run the loop; raises BrokenOffError when its signals grow beyond every number."""
    try:
        # The controller refuses what is not finite: numpy need not say so as well.
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            return loop.run(samples, on_sample)
    except OverflowError as error:
        raise BrokenOffError('the run broke off: a signal grew beyond every number') from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = ' '.join(str(error).split())
        raise BrokenOffError(f'the run broke off: {reason}') from error
