"""A run as every tool reads it, and how one is simulated."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord
from backlash_ros.tools.cli import WHOLE, BrokenOffError, InputError, Span

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """A run that was simulated or recorded.

    parameters: None where no parameters.yaml stands beside it. latency_s: from the departure of
    y(k) at the driver to that of v(k) at the controller, shape (N,), nan where unknown; None for
    a simulation. notes: what the user has to know about the source, a sentence each.
    """

    record: RunRecord
    parameters: Parameters | None
    latency_s: Array | None = None
    notes: tuple[str, ...] = ()


def cut(record: RunRecord, span: Span) -> RunRecord:
    """The rows within the span, their time counted from the first one; raises InputError."""
    if span == WHOLE:
        return record
    t = record.column('t')
    rows = record.rows[(t >= span.from_s) & (t < span.to_s)].copy()
    if not len(rows):
        raise InputError('there is no sample between --from and --to')
    rows[:, COLUMNS.index('t')] -= rows[0, COLUMNS.index('t')]
    # G is recorded as it was believed at the end.
    learned = record.learned if t[-1] < span.to_s else None
    return RunRecord(rows, record.sample_period, record.lost_samples, learned)


def run_loop(
    loop: ClosedLoop, samples: int, on_sample: Callable[[int], None] | None = None,
) -> RunRecord:
    """Simulate a run; raises BrokenOffError when its signals grow beyond every number."""
    try:
        # The controller refuses what is not finite: numpy need not say so as well.
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            return loop.run(samples, on_sample)
    except OverflowError as error:
        raise BrokenOffError('the run broke off: a signal grew beyond every number') from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = ' '.join(str(error).split())
        raise BrokenOffError(f'the run broke off: {reason}') from error
