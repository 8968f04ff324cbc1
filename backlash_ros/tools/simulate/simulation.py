"""One simulated run, and what becomes of one that breaks off."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.cli.errors import BrokenOffError


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
