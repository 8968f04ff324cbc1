"""Jobs that a loop has computed, at once or in a process of their own, and the samples they see.

A job is a pure function of a record and of whatever else it is given. The loop appends samples to a
channel, submits one job at a time, and polls for its result; none of the three waits for a job.
"""

import os
import pickle
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Job = Callable[..., Any]

LOST = 'lost'  # kind of the failure of a job whose worker died


class ChannelSamples(NamedTuple):
    """Consecutive samples, columns (quantities, N), read-only; first: number of the oldest."""

    first: int
    columns: NDArray[np.float64]


class Failure(NamedTuple):
    """What comes of a job without a result: the class of its exception, LOST of a dead worker."""

    kind: str


class SampleBuffer:
    """Samples, one after the other in `values`; first: number of the oldest that is there."""

    def __init__(self, quantities: int, first: int = 0) -> None:
        self.quantities, self.first, self.values = quantities, first, array('d')

    @property
    def end(self) -> int:
        """Number of the next sample."""
        return self.first + len(self.values) // max(self.quantities, 1)

    def drop(self, first: int) -> None:
        """Drop the samples before this number, if they are most of all."""
        if first - self.first > self.end - first:
            del self.values[:(first - self.first) * self.quantities]
            self.first = first

    def values_between(self, first: int, end: int) -> 'array[float]':
        begin, stop = ((k - self.first) * self.quantities for k in (first, max(end, first)))
        return self.values[begin:stop]

    def between(self, first: int, end: int) -> ChannelSamples:
        """A copy of the samples from one number to before another, as far as they are there."""
        first = max(first, self.first)
        rows = np.frombuffer(self.values_between(first, end)).reshape(-1, self.quantities)
        columns = np.array(rows.T, order='C')
        columns.flags.writeable = False
        return ChannelSamples(first, columns)


class Channel:
    """A record, for jobs that need one, and at most one job at a time.

    busy: whether there is a job whose result nobody has polled yet. since, end: it sees the samples
    from the one to before the other number.
    """

    def __init__(self, executor: 'Executor', number: int, quantities: int, capacity: int) -> None:
        self.busy, self.number, self.record = False, number, SampleBuffer(quantities)
        self.since = self.end = 0
        self.result: Callable[[], Any] | None = None  # once it is there
        self._executor, self._capacity = executor, capacity

    def append(self, *values: float) -> None:
        self.record.values.extend(values)

    def submit(self, job: Job, *args: Any, since: int = 0) -> bool:
        """Have job(samples, *args) computed, or job(*args) without a record; False while busy.

        job: a function at the top level of a module, which changes none of its arguments. since:
        number of the first sample that is needed, by this job and those after it.
        """
        if self.busy:
            return False
        self.busy, self.end = True, self.record.end
        self.since = max(since, self.end - self._capacity)
        if self.record.quantities:
            self.record.drop(self.since)
        self._executor.begin(self, job, args)
        return True

    def poll(self) -> Any:
        """The result of the job, or its Failure, once it is finished; None before."""
        result, self.result = self.result, None
        self.busy = self.busy and result is None
        return result and result()

    def close(self) -> None:
        self._executor.forget(self)


class Executor:
    """Computes jobs for any number of channels, each when it is submitted.

    So simulations, lockstep and tests give the same numbers whenever they are made. restarts: how
    many workers have died so far, where there are any.
    """

    restarts = 0

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        """A new channel with a record of the newest `capacity` samples; 0 quantities: no record."""
        return Channel(self, 0, quantities, capacity)

    def begin(self, channel: Channel, job: Job, args: tuple[Any, ...]) -> None:
        result = _computed(job, channel.record, channel.since, channel.end, args)
        channel.result = lambda: result

    def forget(self, channel: Channel) -> None:
        channel.record = SampleBuffer(channel.record.quantities)

    def close(self) -> None:
        """End it; jobs that are under way are dropped."""


def _computed(job: Job, record: SampleBuffer, since: int, end: int, args: tuple[Any, ...]) -> Any:
    try:
        return job(record.between(since, end), *args) if record.quantities else job(*args)
    except Exception as error:  # whatever it is: the loop goes on without this result
        return Failure(type(error).__name__)


class WorkerExecutor(Executor):
    """Computes jobs in a worker process, which begins with the first channel.

    One that dies is replaced, and only the job that was under way is lost. It ends with its parent,
    however that ends, and imports nothing of that program but what jobs need. preload: modules that
    it imports at its start, not with its first job.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        self.restarts, self._preload = 0, tuple(preload)
        self._channels: dict[int, Channel] = {}
        self._submitted: SimpleQueue[tuple[Channel, bytes] | None] = SimpleQueue()
        self._closed = Event()
        self._worker: subprocess.Popen[bytes] | None = None
        self._thread: Thread | None = None
        self._opened = 0  # channels so far

    @property
    def pid(self) -> int | None:
        return None if self._worker is None else self._worker.pid

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        if self._thread is None:
            self._worker = _start(self._preload)
            self._thread = Thread(target=self._exchange, args=(self._worker,), daemon=True)
            self._thread.start()
        self._opened += 1
        channel = self._channels[self._opened] = Channel(self, self._opened, quantities, capacity)
        return channel

    def begin(self, channel: Channel, job: Job, args: tuple[Any, ...]) -> None:
        self._submitted.put((channel, pickle.dumps((job, channel.since, channel.end, args), -1)))

    def forget(self, channel: Channel) -> None:
        # The worker does so when it is sent its next job.
        self._channels.pop(channel.number, None)

    def close(self) -> None:
        self._closed.set()
        self._submitted.put(None)
        if self._worker is not None:
            self._worker.kill()
        if self._thread is not None:
            self._thread.join()
        if self._worker is not None:
            _end(self._worker)

    def _exchange(self, worker: subprocess.Popen[bytes]) -> None:
        """Have jobs done one by one, each sent with the samples that are new to the worker."""
        sent: dict[int, int] = {}  # channel: number of the sample up to which the worker has it
        deaths = 0  # in a row without an answer
        for channel, job in iter(self._submitted.get, None):
            asked = False
            # Nobody waits for the result of one that was closed meanwhile.
            while not asked and channel.number in self._channels:
                assert worker.stdin
                assert worker.stdout
                record = channel.record
                first = max(sent.get(channel.number, 0), record.first)
                new = record.values_between(first, channel.end).tobytes()
                request = channel.number, [*self._channels], record.quantities, first, new, job
                try:
                    pickle.dump(request, worker.stdin, -1)
                    worker.stdin.flush()
                    asked, sent[channel.number] = True, channel.end
                    size = int.from_bytes(worker.stdout.read(8), 'little')
                    body = worker.stdout.read(size)
                    if not 0 < size == len(body):
                        raise EOFError
                    # Not here, where it would keep the loop waiting.
                    channel.result, deaths = partial(pickle.loads, body), 0
                except (OSError, EOFError):
                    self._worker, sent, deaths = None, {}, deaths + 1
                    self.restarts += 1
                    if asked:
                        channel.result = partial(Failure, LOST)
                    _end(worker)
                    # At once, but where it died like the one before it: longer each time.
                    wait_s = min(0.1 * 2.0 ** min(deaths - 2, 7), 10.0) if deaths > 1 else 0.0
                    while self._worker is None and not self._closed.wait(wait_s):
                        try:
                            self._worker = worker = _start(self._preload)
                        except OSError:  # no memory or no more processes
                            wait_s = 10.0
                if self._closed.is_set():
                    return


def _start(preload: tuple[str, ...]) -> subprocess.Popen[bytes]:
    code = f'import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; ' \
        f'serve({preload!r})'
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        # In a session of its own it gets no Ctrl-C, not even while it starts, and what it takes of
        # a processor is not taken from the share of the loop.
        start_new_session=True,
        # A second thread of a fit would take the core on which the loop runs.
        env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
    )
    # From here, so that it holds for its imports as well; a loop in real time passes that on.
    os.sched_setscheduler(process.pid, os.SCHED_OTHER, os.sched_param(0))
    niceness = os.getpriority(os.PRIO_PROCESS, 0) + 5
    os.setpriority(os.PRIO_PROCESS, process.pid, niceness)
    with suppress(OSError):  # a kernel that does not share the processors between sessions
        Path(f'/proc/{process.pid}/autogroup').write_text(str(niceness))
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with suppress(BrokenPipeError), process:  # waits for its end, and closes its pipes
        pass


# --- in the worker ------------------------------------------------------------------------------


def serve(preload: Sequence[str] = ()) -> None:
    """Compute jobs until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
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
        number, still_open, quantities, first, block, job = requests.get()
        began = time.process_time()
        if number not in records or records[number].end != first:
            records[number] = SampleBuffer(quantities, first)
        records[number].values.frombytes(block)
        result = _result_of(job, records[number])
        results.write(len(result).to_bytes(8, 'little') + result)
        results.flush()
        records = {number: record for number, record in records.items() if number in still_open}
        earned = share * max(sum(record.quantities > 0 for record in records.values()), 1)
        credit_s += earned * (time.monotonic() - since)
        since = time.monotonic()
        credit_s = min(credit_s, burst_s) - (time.process_time() - began)
        time.sleep(max(-credit_s / earned, 0.0))


def _receive(requests: SimpleQueue[Any]) -> None:
    """Read requests, also while a job is computed, and end the process with the pipe."""
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            requests.put(pickle.load(sys.stdin.buffer))
    os._exit(0)


def _result_of(job: bytes, record: SampleBuffer) -> bytes:
    """The pickled result of a job, or Failure where job or result cannot be pickled."""
    try:
        function, since, end, args = pickle.loads(job)
        if record.quantities:
            record.drop(since)
        return pickle.dumps(_computed(function, record, since, end, args), -1)
    except Exception as error:
        return pickle.dumps(Failure(type(error).__name__), -1)
