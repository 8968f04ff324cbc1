"""Jobs that a loop has computed, at once or elsewhere, and the record of samples that they see.

A job is a pure function of a record and of whatever else it is given. The loop appends samples to a
channel, submits one job at a time, and polls for its result; none of the three waits for a job that
runs in a worker process (worker.py). `Executor` itself computes it at once, so that simulations,
lockstep and tests give the same numbers whenever they are made.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Job = Callable[..., Any]

LOST = 'lost'  # kind of the failure of a job whose worker died


class ChannelSamples(NamedTuple):
    """Consecutive samples, the newest last.

    first: number of the first of them, counted from the first one ever appended. columns: their
    values, shape (quantities, N), read-only.
    """

    first: int
    columns: Array


class Failure(NamedTuple):
    """What comes of a job without a result: the class of its exception, LOST of a dead worker."""

    kind: str


class SampleBuffer:
    """Samples of some quantities, of which the oldest may be dropped; first: number of the first.

    values: sample by sample.
    """

    def __init__(self, quantities: int, first: int = 0) -> None:
        self.quantities, self.first = quantities, first
        self.values = array('d')

    @property
    def end(self) -> int:
        """Number of the next sample."""
        return self.first + len(self.values) // max(self.quantities, 1)

    def drop(self, first: int) -> None:
        """Drop the samples before this number, if they are most of all."""
        if first - self.first > self.end - first:
            del self.values[:(first - self.first) * self.quantities]
            self.first = first

    def between(self, first: int, end: int) -> ChannelSamples:
        """A copy of the samples from one number to before another, as far as they are there."""
        first = max(first, self.first)
        begin, stop = ((k - self.first) * self.quantities for k in (first, max(end, first)))
        rows = np.frombuffer(self.values[begin:stop]).reshape(-1, self.quantities)
        columns = np.array(rows.T, order='C')
        columns.flags.writeable = False
        return ChannelSamples(first, columns)


class Channel:
    """A record, for jobs that need one, and at most one job at a time.

    busy: whether there is a job whose result nobody has polled yet. number: of the channel. job,
    args: the newest that was submitted, which sees the samples from `since` to before `end`.
    result: of it. sent: number of the sample up to which a worker has the record.
    """

    def __init__(self, executor: Executor, number: int, quantities: int, capacity: int) -> None:
        self.busy, self.number, self.record = False, number, SampleBuffer(quantities)
        self.job: Job | None = None
        self.args: tuple[Any, ...] = ()
        self.since = self.end = self.sent = 0
        self.result: Any = None
        self._executor, self._capacity = executor, capacity

    def append(self, *values: float) -> None:
        """Append a sample to the record."""
        self.record.values.extend(values)

    def submit(self, job: Job, *args: Any, since: int = 0) -> bool:
        """Have job(samples, *args) computed, with the samples that there are now.

        job: a function at the top level of a module, which changes none of its arguments. Without
        a record it is job(*args). since: number of the first sample that is needed, by this job
        and those after it. Returns False, and does nothing, while the channel is busy.
        """
        if self.busy:
            return False
        self.busy, self.job, self.args, self.end = True, job, args, self.record.end
        self.since = max(since, self.end - self._capacity)
        if self.record.quantities:
            self.record.drop(self.since)
        self._executor.begin(self)
        return True

    def poll(self) -> Any:
        """The result of the job, or its Failure, once it is finished; None before."""
        self._executor.tend()
        result, self.result = self.result, None
        self.busy = self.busy and result is None
        return result

    def close(self) -> None:
        """Drop record and job."""
        self._executor.forget(self)


class Executor:
    """Computes jobs for any number of channels, each when it is submitted.

    restarts: how many workers have died so far, where there are any.
    """

    restarts = 0

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        """A new channel with a record of the newest `capacity` samples; 0 quantities: no record."""
        return Channel(self, 0, quantities, capacity)

    def begin(self, channel: Channel) -> None:
        """Have the job of a channel computed, after those that were submitted before it."""
        assert channel.job is not None
        channel.result = computed(
            channel.job, channel.record, channel.since, channel.end, channel.args
        )

    def tend(self) -> None:
        """Do what is left to do; for whenever nothing waits for the caller."""

    def forget(self, channel: Channel) -> None:
        """Drop record and job of a channel."""
        channel.record = SampleBuffer(channel.record.quantities)

    def close(self) -> None:
        """End it; jobs that are under way are dropped."""


def computed(job: Job, record: SampleBuffer, since: int, end: int, args: tuple[Any, ...]) -> Any:
    """The result of a job for the samples from `since` to before `end`; a Failure if it raises."""
    try:
        return job(record.between(since, end), *args) if record.quantities else job(*args)
    except Exception as error:  # whatever it is: the loop goes on without this result
        return Failure(type(error).__name__)
