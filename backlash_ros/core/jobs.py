"""Jobs that a loop has computed, at once or elsewhere, and the record of samples that they see.

A job is a pure function of a record and of whatever else it is given. The loop appends samples to a
channel, submits one job at a time, and polls for its result; none of the three waits for a job that
runs in a worker process (worker.py). `Executor` itself computes it at once, so that simulations,
lockstep and tests give the same numbers whenever they are made.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, BinaryIO, NamedTuple

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


@dataclass
class _Worker:
    """A process, what it has yet to be written, what has come of an answer.

    sent: jobs without a result that it has, the last of which may be written in part.
    """

    process: subprocess.Popen[bytes]
    unwritten: bytearray = field(default_factory=bytearray)
    received: bytearray = field(default_factory=bytearray)
    sent: int = 0


class WorkerExecutor(Executor):
    """Computes jobs in a worker process, which begins with the first channel.

    preload: modules that the worker imports at its start, not with its first job.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        self.restarts = 0
        self._preload = tuple(preload)
        self._channels: dict[int, Channel] = {}
        self._opened = 0  # channels so far
        self._submitted: deque[Channel] = deque()  # of each job without a result, in order
        self._deaths = 0  # in a row without an answer
        self._closed = Event()
        self._starting: Thread | None = None
        self._started: SimpleQueue[subprocess.Popen[bytes]] = SimpleQueue()
        self._worker: _Worker | None = None

    @property
    def pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return None if self._worker is None else self._worker.process.pid

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        if self._opened == 0:
            self._worker = _Worker(_start(self._preload))
        self._opened += 1
        channel = self._channels[self._opened] = Channel(self, self._opened, quantities, capacity)
        return channel

    def close(self) -> None:
        self._closed.set()
        if self._starting is not None:
            self._starting.join()
        while not self._started.empty():
            _end(self._started.get())
        if self._worker is not None:
            _end(self._worker.process)
            self._worker = None

    # --- for its channels -----------------------------------------------------------------------

    def begin(self, channel: Channel) -> None:
        self._submitted.append(channel)
        self.tend()

    def forget(self, channel: Channel) -> None:
        # The worker does so when it is sent its next job.
        self._channels.pop(channel.number, None)

    def tend(self) -> None:
        # Write what the pipe takes, read what has come, replace a worker that died.
        if self._worker is None and not self._started.empty():
            self._take_over(self._started.get())
        worker = self._worker
        if worker is None or worker.process.stdin is None or worker.process.stdout is None:
            return
        try:
            self._write_to(worker, worker.process.stdin.fileno())
            received = os.read(worker.process.stdout.fileno(), 65536)  # at once, at most
        except BlockingIOError:  # nothing has come
            return
        except BrokenPipeError:
            received = b''
        if not received:
            self._replace(worker)
            return
        worker.received += received
        for number, body in _answers_in(worker.received):
            self._deaths = 0
            self._submitted.popleft()
            worker.sent -= 1
            if number in self._channels:
                self._channels[number].result = pickle.loads(body)

    def _write_to(self, worker: _Worker, pipe: int) -> None:
        while worker.unwritten or worker.sent < len(self._submitted):
            if not worker.unwritten:
                worker.unwritten += _request(self._submitted[worker.sent], [*self._channels])
                worker.sent += 1
            try:
                del worker.unwritten[:os.write(pipe, worker.unwritten)]
            except BlockingIOError:  # the pipe is full
                return

    def _replace(self, dead: _Worker) -> None:
        """Start another worker in the background; the job that was under way is lost."""
        self._worker = None
        self.restarts += 1
        self._deaths += 1
        if dead.sent > bool(dead.unwritten):
            self._submitted.popleft().result = Failure(LOST)
        # At once, but where it died without an answer as the one before it did: longer each time.
        wait_s = min(0.1 * 2.0 ** min(self._deaths - 2, 7), 10.0) if self._deaths > 1 else 0.0
        self._starting = Thread(
            target=self._start_another, args=(dead.process, wait_s), daemon=True)
        self._starting.start()

    def _start_another(self, dead: subprocess.Popen[bytes], wait_s: float) -> None:
        _end(dead)
        while not self._closed.wait(wait_s):
            try:
                self._started.put(_start(self._preload))
            except OSError:  # no memory or no more processes
                wait_s = 10.0
            else:
                return

    def _take_over(self, process: subprocess.Popen[bytes]) -> None:
        """Have a new worker told all that the dead one knew."""
        self._worker = _Worker(process)
        for channel in self._channels.values():
            channel.sent = 0
        # Those that were closed meanwhile have nobody who waits for a result.
        self._submitted = deque(c for c in self._submitted if c.number in self._channels)


def _request(channel: Channel, still_open: list[int]) -> bytes:
    """What a worker is sent: a job, and the samples that it does not have yet."""
    record = channel.record
    first = max(channel.sent, record.first)
    begin, stop = ((k - record.first) * record.quantities for k in (first, channel.end))
    channel.sent = channel.end
    samples = record.quantities, first, record.values[begin:stop].tobytes()
    job = pickle.dumps((channel.job, channel.since, channel.end, channel.args), -1)
    return pickle.dumps((channel.number, still_open, samples, job), -1)


def _answers_in(received: bytearray) -> Iterator[Any]:
    """Take the complete answers out of what was received."""
    while len(received) >= 8:  # bytes of the length
        end = 8 + int.from_bytes(received[:8], 'little')
        if len(received) < end:
            return
        body = bytes(received[8:end])
        del received[:end]
        yield pickle.loads(body)


def _start(preload: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start a worker: a bare interpreter that imports this module and what it is told to."""
    code = f'import sys; sys.path[:] = {sys.path!r}; ' \
        f'from {__name__} import serve; serve({preload!r})'
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
        # In a session of its own it gets no Ctrl-C, not even while it starts, and what it takes of
        # a processor is not taken from the share of the loop.
        start_new_session=True,
        # A second thread of a fit would take the core on which the loop runs.
        env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
    )
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
    # From here, so that it holds for its imports as well; a loop in real time passes that on.
    os.sched_setscheduler(process.pid, os.SCHED_OTHER, os.sched_param(0))
    niceness = os.getpriority(os.PRIO_PROCESS, 0) + 5
    os.setpriority(os.PRIO_PROCESS, process.pid, niceness)
    with suppress(OSError):  # a kernel that does not share the processors between sessions
        Path(f'/proc/{process.pid}/autogroup').write_text(str(niceness))
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with process:  # waits for its end, and closes its pipes
        pass


# --- in the worker ------------------------------------------------------------------------------


def serve(preload: Sequence[str] = ()) -> None:
    """Compute jobs until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    results = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # whatever a job prints is no result
    sys.stdout = sys.stderr
    requests: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_receive, args=(requests,), daemon=True).start()
    for name in preload:
        import_module(name)
    records: dict[int, SampleBuffer] = {}
    # Where nothing explains what a plant does, one search follows the other. On average they get
    # this share of a processor for each record, so that no command is late for them.
    share, burst_s = 0.25, 5.0
    credit_s, since = burst_s, time.monotonic()
    while True:
        number, still_open, samples, job = requests.get()
        began = time.process_time()
        _send(results, (number, _result_of(job, _extended(records, number, *samples))))
        records = {number: record for number, record in records.items() if number in still_open}
        earned = share * max(sum(record.quantities > 0 for record in records.values()), 1)
        credit_s += earned * (time.monotonic() - since)
        since = time.monotonic()
        credit_s = min(credit_s, burst_s) - (time.process_time() - began)
        time.sleep(max(-credit_s / earned, 0.0))


def _receive(requests: SimpleQueue[Any]) -> None:
    """Read requests, also while a job is computed, and end the process with the pipe."""
    while True:
        try:
            requests.put(pickle.load(sys.stdin.buffer))
        except (EOFError, pickle.UnpicklingError):
            os._exit(0)


def _extended(
    records: dict[int, SampleBuffer], number: int, quantities: int, first: int, block: bytes,
) -> SampleBuffer:
    """The record of a channel with samples from number `first` on."""
    if number not in records or records[number].end != first:
        records[number] = SampleBuffer(quantities, first)
    records[number].values.frombytes(block)
    return records[number]


def _result_of(body: bytes, record: SampleBuffer) -> bytes:
    """The pickled result of a job, or Failure where job or result cannot be pickled."""
    try:
        job, since, end, args = pickle.loads(body)
        if record.quantities:
            record.drop(since)
        return pickle.dumps(computed(job, record, since, end, args), -1)
    except Exception as error:
        return pickle.dumps(Failure(type(error).__name__), -1)


def _send(pipe: BinaryIO, content: Any) -> None:
    body = pickle.dumps(content, -1)
    try:
        pipe.write(len(body).to_bytes(8, 'little') + body)
        pipe.flush()
    except BrokenPipeError:  # its parent is gone
        os._exit(0)
