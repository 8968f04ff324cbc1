"""Where fits are computed, beside the loop or within it: one protocol, and the latter.

A job is a pure function of a record and of whatever else it is given. The loop appends samples to a
channel, submits one job at a time, and polls for its result; none of the three waits for a job that
runs elsewhere (worker.py). `InlineExecutor` runs it at once, so that simulations, lockstep and
tests give the same numbers whenever they are made.
"""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Job = Callable[..., Any]

BLOCK = 64  # samples that are handed over at once
LOST = 'lost'  # kind of the failure of a job whose worker died


class Samples(NamedTuple):
    """Consecutive samples, the newest last.

    first: number of the first of them, counted from the first one ever appended. columns: their
    values, shape (quantities, N), read-only.
    """

    first: int
    columns: Array


@dataclass(frozen=True)
class Failure:
    """What comes of a job that has no result.

    kind: name of the class of the exception that it raised, LOST where its worker died. text: the
    traceback.
    """

    kind: str
    text: str


class Channel(ABC):
    """A record and at most one job at a time.

    quantities: values of a sample, 0 where jobs need no record.
    """

    def __init__(self, quantities: int) -> None:
        self.busy = False  # whether there is a job whose result nobody has polled yet
        self._quantities = quantities
        self._appended = array('d')  # values that are not handed over yet
        self._handed_over = 0  # samples
        self._results: list[Any] = []  # none or one

    def append(self, *values: float) -> None:
        """Append a sample to the record."""
        self._appended.extend(values)

    def tend(self) -> None:
        """Do what `append` leaves undone; for whenever nothing waits for the caller."""
        if self._quantities and len(self._appended) >= BLOCK * self._quantities:
            self._hand_over()

    def submit(self, job: Job, *args: Any) -> bool:
        """Have job(samples, *args) computed, samples being the record as it is now.

        job: a function at the top level of a module, which changes none of its arguments. Without
        a record it is job(*args). Returns False, and does nothing, while the channel is busy.
        """
        if self.busy:
            return False
        self._hand_over()
        self.busy = True
        self._begin(job, args)
        return True

    def poll(self) -> Any:
        """The result of the job, or its Failure, once it is finished; None before."""
        if not self._results:
            return None
        self.busy = False
        return self._results.pop()

    def _hand_over(self) -> None:
        if self._appended:
            self._handed_over += len(self._appended) // self._quantities
            block, self._appended = self._appended.tobytes(), array('d')
            self._extend(block)

    @abstractmethod
    def close(self) -> None:
        """Drop record and job."""

    @abstractmethod
    def _extend(self, block: bytes) -> None:
        """Append doubles, sample by sample, to the record that jobs see."""

    @abstractmethod
    def _begin(self, job: Job, args: tuple[Any, ...]) -> None:
        """Have a job computed."""


class Executor(Protocol):
    """Computes jobs for any number of channels, in the order of their submission."""

    @property
    def alive(self) -> bool:
        """Whether jobs are computed at present."""

    @property
    def restarts(self) -> int:
        """How many workers have died so far."""

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        """A new channel with a record of the newest `capacity` samples; 0 quantities: no record."""

    def close(self) -> None:
        """End it; jobs that are under way are dropped."""


class Record:
    """The newest samples of a channel.

    quantities: values per sample. capacity: samples kept. first: number of the first sample.
    """

    def __init__(self, quantities: int, capacity: int, first: int = 0) -> None:
        self._capacity = capacity
        self._columns: Array = np.empty((quantities, 1024))
        self._first, self._count = first, 0

    def extend(self, block: bytes) -> None:
        """Append samples, given one after the other as doubles."""
        columns = np.frombuffer(block).reshape(-1, len(self._columns)).T
        new = columns.shape[1]
        if self._count + new > self._columns.shape[1]:
            # Room for as many again, so that samples are rarely moved.
            kept = min(self._count, self._capacity)
            larger = np.empty((len(columns), 2 * (kept + new)))
            larger[:, :kept] = self._columns[:, self._count - kept:self._count]
            self._first += self._count - kept
            self._columns, self._count = larger, kept
        self._columns[:, self._count:self._count + new] = columns
        self._count += new

    def until(self, end: int) -> Samples:
        """The newest samples of those with a number below `end`, as a view."""
        count = end - self._first
        begin = max(count - self._capacity, 0)
        view = self._columns[:, begin:count]
        view.flags.writeable = False
        return Samples(self._first + begin, view)


def computed(job: Job, record: Record | None, end: int, args: tuple[Any, ...]) -> Any:
    """The result of a job for the samples below number `end`; a Failure where it raises."""
    try:
        return job(*args) if record is None else job(record.until(end), *args)
    except Exception as error:  # whatever it is: the loop goes on without this result
        return Failure(type(error).__name__, traceback.format_exc())


class InlineExecutor:
    """Computes every job when it is submitted."""

    alive, restarts = True, 0

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        """A new channel with a record of the newest `capacity` samples; 0 quantities: no record."""
        return _InlineChannel(quantities, capacity)

    def close(self) -> None:
        """Nothing is under way."""


class _InlineChannel(Channel):
    def __init__(self, quantities: int, capacity: int) -> None:
        super().__init__(quantities)
        self._record = Record(quantities, capacity) if quantities else None

    def _extend(self, block: bytes) -> None:
        assert self._record is not None
        self._record.extend(block)

    def _begin(self, job: Job, args: tuple[Any, ...]) -> None:
        self._results.append(computed(job, self._record, self._handed_over, args))

    def close(self) -> None:
        self._record = None
        self._results.clear()
