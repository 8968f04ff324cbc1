"""A process of its own for fits, which the loop never waits for.

The loop's side writes blocks of samples, and jobs, into a pipe as far as that takes them, and reads
what has come back. A worker that dies is replaced in the background: samples and jobs are sent
again, but for the job that was under way. The worker ends when its pipe does, that is with its
parent, however that ends. It imports NumPy, SciPy and what its jobs need, never the program that
started it, and so nothing of ROS.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from importlib import import_module
from itertools import islice
from queue import SimpleQueue
from struct import Struct
from threading import Event, Thread
from typing import Any, NamedTuple

from backlash_ros.core.jobs.executor import LOST, Channel, Failure, Job, Record, computed

NICENESS = 5  # beyond that of the loop
OPEN, EXTEND, SUBMIT, CLOSE, RESULT, READY = range(6)  # kinds of messages
HEADER = Struct('<BQQ')  # kind, number of the channel, bytes that follow
RECORD = Struct('<QQQ')  # quantities, capacity and number of the first sample
READ_BYTES, WRITTEN_MESSAGES = 65536, 32  # at once, at most
# Wait before a worker is replaced [s] that died at its start or at a job, as the one before it did:
# the first, and the longest, by doubling.
FIRST_WAIT_S, LONGEST_WAIT_S = 0.1, 10.0


class _Received(NamedTuple):
    kind: int
    number: int  # of the channel
    body: bytes


class WorkerExecutor:
    """Computes jobs in a worker process, which begins with the first channel.

    preload: modules that the worker imports at its start, not with its first job. restarts: how
    many workers have died so far.
    """

    def __init__(self, preload: Sequence[str] = ()) -> None:
        self.restarts = 0
        self._preload = tuple(preload)
        self._channels: dict[int, _WorkerChannel] = {}
        self._opened = 0  # channels so far
        self._submitted: deque[_WorkerChannel] = deque()  # of each job without a result, in order
        self._unwritten: deque[bytes] = deque()
        self._begun = 0  # bytes of the first of them that are written
        self._at_work = 0  # jobs that are written and have no result
        self._received = bytearray()
        self._deaths = 0  # in a row at the start of a worker or at a job
        self._ready = False  # whether the worker has started
        self._closed = Event()
        self._starting: Thread | None = None
        self._started: SimpleQueue[subprocess.Popen[bytes]] = SimpleQueue()
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def alive(self) -> bool:
        """Whether there is a worker at present."""
        return self._process is not None

    @property
    def pid(self) -> int | None:
        """Process id of the worker; None while there is none."""
        return None if self._process is None else self._process.pid

    def open(self, quantities: int = 0, capacity: int = 0) -> Channel:
        """A new channel with a record of the newest `capacity` samples; 0 quantities: no record."""
        if self._opened == 0:
            self._process = _start(self._preload)
        channel = _WorkerChannel(self, self._opened, quantities, capacity)
        self._opened += 1
        self._channels[channel.number] = channel
        self.write(channel.opening)
        return channel

    def close(self) -> None:
        """End the worker."""
        self._closed.set()
        if self._starting is not None:
            self._starting.join()
        while not self._started.empty():
            _end(self._started.get())
        if self._process is not None:
            _end(self._process)
            self._process = None

    # --- for its channels -----------------------------------------------------------------------

    def write(self, message: bytes) -> None:
        """Send a message as soon as the worker takes it; one that is to come is told anyhow."""
        if self._process is not None:
            self._unwritten.append(message)
        self.tend()

    def submit(self, channel: _WorkerChannel) -> None:
        """Have the job of a channel computed."""
        self._submitted.append(channel)
        self.write(channel.job)

    def forget(self, channel: _WorkerChannel) -> None:
        """Drop record and job of a channel."""
        if self._channels.pop(channel.number, None) is not None:
            self.write(_message(CLOSE, channel.number))

    def tend(self) -> None:
        """Write what the pipe takes, read what has come, replace a worker that died."""
        if self._process is None and not self._started.empty():
            self._take_over(self._started.get())
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return
        try:
            if self._unwritten:
                self._write_to(process.stdin.fileno())
            received = os.read(process.stdout.fileno(), READ_BYTES)
        except BlockingIOError:  # nothing has come
            return
        except BrokenPipeError:
            received = b''
        if not received:
            self._replace(process)
            return
        self._received += received
        for kind, number, body in _messages_in(self._received):
            self._ready = True
            if kind == READY:
                continue
            self._deaths = 0
            self._at_work -= 1
            self._submitted.popleft()
            if number in self._channels:
                self._channels[number].finish(pickle.loads(body))

    def _write_to(self, pipe: int) -> None:
        messages = self._unwritten
        first = memoryview(messages[0])[self._begun:]
        try:
            written = os.writev(pipe, [first, *islice(messages, 1, WRITTEN_MESSAGES)])
        except BlockingIOError:  # the pipe is full
            return
        self._begun += written
        while messages and self._begun >= len(messages[0]):
            message = messages.popleft()
            self._begun -= len(message)
            self._at_work += message[0] == SUBMIT

    def _replace(self, dead: subprocess.Popen[bytes]) -> None:
        """Start another worker in the background; the job that was under way is lost."""
        self._process = None
        self.restarts += 1
        self._deaths = self._deaths + 1 if self._at_work or not self._ready else 0
        if self._at_work:
            lost = self._submitted.popleft()
            lost.finish(Failure(LOST, f'the worker (process {dead.pid}) died'))
        self._unwritten.clear()
        self._received.clear()
        self._begun, self._at_work, self._ready = 0, 0, False
        wait_s = 0.0
        if self._deaths > 1:
            wait_s = min(FIRST_WAIT_S * 2.0 ** min(self._deaths - 2, 10), LONGEST_WAIT_S)
        self._starting = Thread(target=self._start_another, args=(dead, wait_s), daemon=True)
        self._starting.start()

    def _start_another(self, dead: subprocess.Popen[bytes], wait_s: float) -> None:
        _end(dead)
        while not self._closed.wait(wait_s):
            try:
                self._started.put(_start(self._preload))
            except OSError:  # no memory or no more processes
                wait_s = LONGEST_WAIT_S
            else:
                return

    def _take_over(self, process: subprocess.Popen[bytes]) -> None:
        """Tell a new worker all that the dead one knew."""
        self._process = process
        for channel in self._channels.values():
            self._unwritten.append(channel.opening)
            self._unwritten.extend(channel.blocks)
        # Those that were closed meanwhile have nobody who waits for a result.
        self._submitted = deque(c for c in self._submitted if c.number in self._channels)
        self._unwritten.extend(channel.job for channel in self._submitted)


class _WorkerChannel(Channel):
    """A channel of a WorkerExecutor. blocks, job: the messages that a new worker has to be sent."""

    def __init__(
        self, executor: WorkerExecutor, number: int, quantities: int, capacity: int,
    ) -> None:
        super().__init__(quantities)
        self.number, self.blocks, self.job = number, deque[bytes](), b''
        self._executor, self._capacity = executor, capacity
        self._size = quantities * self._appended.itemsize  # of a sample, in bytes
        self._dropped = 0  # samples before `blocks`

    @property
    def opening(self) -> bytes:
        """The message that opens it, for a record that begins with `blocks`."""
        sizes = RECORD.pack(self._quantities, self._capacity, self._dropped)
        return _message(OPEN, self.number, sizes)

    def poll(self) -> Any:
        self._executor.tend()
        return super().poll()

    def _extend(self, block: bytes) -> None:
        message = _message(EXTEND, self.number, block)
        self.blocks.append(message)
        needed = self._handed_over - self._capacity  # samples before it are not
        while (after := self._dropped + self._samples_in(self.blocks[0])) <= needed:
            self._dropped = after
            self.blocks.popleft()
        self._executor.write(message)

    def _samples_in(self, message: bytes) -> int:
        return (len(message) - HEADER.size) // self._size

    def _begin(self, job: Job, args: tuple[Any, ...]) -> None:
        body = pickle.dumps((job, self._handed_over, args), -1)
        self.job = _message(SUBMIT, self.number, body)
        self._executor.submit(self)

    def finish(self, result: Any) -> None:
        """Take in the result of the job."""
        self._results.append(result)

    def close(self) -> None:
        self._executor.forget(self)


def _message(kind: int, number: int, body: bytes = b'') -> bytes:
    return HEADER.pack(kind, number, len(body)) + body


def _messages_in(received: bytearray) -> Iterator[_Received]:
    """Take the complete messages out of what was received."""
    while len(received) >= HEADER.size:
        kind, number, length = HEADER.unpack_from(received)
        end = HEADER.size + length
        if len(received) < end:
            return
        body = bytes(received[HEADER.size:end])
        del received[:end]
        yield _Received(kind, number, body)


def _start(preload: tuple[str, ...]) -> subprocess.Popen[bytes]:
    """Start a worker: a bare interpreter that imports this module and what it is told to."""
    code = f'import sys; sys.path[:] = {sys.path!r}; ' \
        f'from {__name__} import serve; serve({preload!r})'
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
        # In a session of its own it gets no Ctrl-C, not even while it starts.
        start_new_session=True,
        # A second thread of a fit would take the core on which the loop runs.
        env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
    )
    for pipe in (process.stdin, process.stdout):
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
    # From here, so that it holds for its imports as well; a loop in real time passes that on.
    os.sched_setscheduler(process.pid, os.SCHED_OTHER, os.sched_param(0))
    niceness = os.getpriority(os.PRIO_PROCESS, 0) + NICENESS
    os.setpriority(os.PRIO_PROCESS, process.pid, niceness)
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    with process:  # waits for its end, and closes its pipes
        pass


# --- in the worker ------------------------------------------------------------------------------


def serve(preload: Sequence[str] = ()) -> None:
    """Compute jobs until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    results = os.dup(1)
    os.dup2(2, 1)  # whatever a job prints is no result
    sys.stdout = sys.stderr
    messages: SimpleQueue[_Received] = SimpleQueue()
    Thread(target=_receive, args=(messages,), daemon=True).start()
    for name in preload:
        import_module(name)
    _send(results, _message(READY, 0))
    records: dict[int, Record | None] = {}
    while True:
        kind, number, body = messages.get()
        if kind == OPEN:
            quantities, capacity, first = RECORD.unpack(body)
            records[number] = Record(quantities, capacity, first) if quantities else None
        elif kind == CLOSE:
            del records[number]
        elif kind == EXTEND:
            record = records[number]
            assert record is not None
            record.extend(body)
        else:
            _send(results, _message(RESULT, number, _result_of(body, records[number])))


def _receive(messages: SimpleQueue[_Received]) -> None:
    """Read messages, also while a job is computed, and end the process with the pipe."""
    source = sys.stdin.buffer
    while len(header := source.read(HEADER.size)) == HEADER.size:
        kind, number, length = HEADER.unpack(header)
        messages.put(_Received(kind, number, source.read(length)))
    os._exit(0)


def _result_of(body: bytes, record: Record | None) -> bytes:
    """The pickled result of a job, or Failure where job or result cannot be pickled."""
    try:
        job, end, args = pickle.loads(body)
        return pickle.dumps(computed(job, record, end, args), -1)
    except Exception as error:
        return pickle.dumps(Failure(type(error).__name__, traceback.format_exc()), -1)


def _send(pipe: int, message: bytes) -> None:
    rest = memoryview(message)
    try:
        while rest:
            rest = rest[os.write(pipe, rest):]
    except BrokenPipeError:  # its parent is gone
        os._exit(0)
