"""A process of its own for jobs, which the loop never waits for.

The loop's side writes into a pipe as far as that takes it, each job with the samples that the
worker does not have yet, and reads what has come back. A worker that dies is replaced in the
background: samples and jobs are sent again, but for the job that was under way. The worker ends
when its pipe does, that is with its parent, however that ends. It imports NumPy, SciPy and what its
jobs need, never the program that started it, and so nothing of ROS.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from typing import Any, BinaryIO

from backlash_ros.core.jobs.executor import LOST, Channel, Executor, Failure, SampleBuffer, computed


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
