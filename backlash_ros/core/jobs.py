"""Jobs that are computed for a loop, at once or in a worker process.

A job is a pure function of its arguments. The loop submits one at a time to a channel and polls for
its result; with a worker process neither of these calls waits.
"""

import ctypes
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib import import_module
from queue import SimpleQueue
from threading import Event, Thread
from typing import IO, Any, NamedTuple

from backlash_ros.core.priority import compute_beside

Job = Callable[..., Any]
Message = Sequence[bytes | bytearray | memoryview]  # a pickled object, and the arrays in it

LOST = 'lost'  # kind of Failure if the worker died


class Failure(NamedTuple):
    """Why a job has no result: the class name of its exception, or LOST if the worker died."""

    kind: str


class Channel:
    """Runs one job at a time. busy: whether a job is under way, or its result not polled yet.

    answer: gives the result, once a worker has sent it. ready: the result itself.
    """

    def __init__(self, executor: 'Executor') -> None:
        self.busy = self.closed = False
        self.answer: Callable[[], Any] | None = None
        self.ready: tuple[Any] | None = None
        self._executor = executor

    def submit(self, job: Job, *args: Any) -> None:
        """Have job(*args) computed; call only if not busy.

        job: a function at the top level of a module that does not modify its arguments.
        """
        self.busy = True
        self._executor.begin(self, job, args)

    def poll(self) -> Any:
        """The result of the job, or a Failure, once it is finished; None until then.

        What a worker has sent is unpickled in one call and returned by the next, as both that and
        the use of it take a good part of a sample.
        """
        if self.answer is not None:
            self.ready, self.answer = (self.answer(),), None
        elif self.ready is not None:
            (result,), self.ready, self.busy = self.ready, None, False
            return result
        return None

    def close(self) -> None:
        """Abandon the job: its result is no longer wanted."""
        self.closed = True


class Executor:
    """Computes each job at once when it is submitted, for any number of channels.

    This makes simulation, lockstep and tests reproducible. restarts: number of workers that have
    died so far, if there are workers.
    """

    restarts = 0

    def open(self) -> Channel:
        return Channel(self)

    def begin(self, channel: Channel, job: Job, args: tuple[Any, ...]) -> None:
        result: Any
        try:
            result = job(*args)
        except Exception as error:  # of any kind: the loop goes on without this result
            result = Failure(type(error).__name__)
        channel.ready = (result,)

    def close(self) -> None:
        """Stop; jobs that are under way are dropped."""


class WorkerExecutor(Executor):
    """Computes jobs in a worker process, started when the first channel is opened.

    If the worker dies it is replaced, and only the job under way is lost. It ends with its parent,
    however that ends, and imports only what jobs need. preload: modules to import at its start, not
    with the first job. loops: number of loops it serves, which sets its share of a processor.
    worker: the process; jobs are pickled to its standard input, results from its standard output.
    """

    def __init__(self, preload: Sequence[str] = (), loops: int = 1) -> None:
        self.restarts, self._arguments = 0, (tuple(preload), loops)
        self._submitted: SimpleQueue[tuple[Channel, Message] | None] = SimpleQueue()
        self._closed = Event()
        self.worker: subprocess.Popen[bytes] | None = None
        self._thread: Thread | None = None

    def open(self) -> Channel:
        if self._thread is None:
            self.worker = _start(*self._arguments)
            self._thread = Thread(target=self._exchange, daemon=True)
            self._thread.start()
        return super().open()

    def begin(self, channel: Channel, job: Job, args: tuple[Any, ...]) -> None:
        # To copy the record could take longer than a sample: the thread sends arrays as they are.
        arrays: list[pickle.PickleBuffer] = []
        body = pickle.dumps((job, args), -1, buffer_callback=arrays.append)
        self._submitted.put((channel, [body, *(each.raw() for each in arrays)]))

    def close(self) -> None:
        self._closed.set()
        self._submitted.put(None)
        while self._thread is not None and self._thread.is_alive():
            worker = self.worker
            if worker is not None:
                worker.kill()
            self._thread.join(0.1)

    def _exchange(self) -> None:
        """Pass jobs to the worker one by one; runs in a thread of its own."""
        deaths = 0  # of workers in a row, without an answer between
        for channel, job in iter(self._submitted.get, None):
            asked = False
            while not (asked or channel.closed or self._closed.is_set()):
                try:
                    self.worker = self.worker or _start(*self._arguments)
                    assert self.worker.stdin
                    assert self.worker.stdout
                    _send(self.worker.stdin, job)
                    asked = True
                    body, = _receive(self.worker.stdout)
                    # Unpickled in poll: in this thread it would block the loop at any time.
                    channel.answer, deaths = partial(pickle.loads, body), 0
                # OSError also if a worker cannot be started: no memory, or too many processes.
                except (OSError, EOFError, pickle.UnpicklingError):
                    self._end_worker()
                    self.restarts, deaths = self.restarts + 1, deaths + 1
                    if asked:
                        channel.answer = partial(Failure, LOST)
                    if deaths > 1:  # as the previous one did
                        self._closed.wait(min(0.1 * 2.0 ** min(deaths, 7), 10.0))
        self._end_worker()

    def _end_worker(self) -> None:
        worker, self.worker = self.worker, None
        if worker is not None:
            with suppress(OSError), worker:  # closing flushes what could not be sent
                worker.kill()


def _start(preload: tuple[str, ...], loops: int) -> subprocess.Popen[bytes]:
    code = f'import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; ' \
        f'serve({os.getpid()}, {preload!r}, {loops})'
    process = subprocess.Popen(
        [sys.executable, '-c', code], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        # A session of its own: no Ctrl-C reaches it, even while it starts, and its processor time
        # does not count against the share of the loop.
        start_new_session=True,
        # A second thread for linear algebra would occupy the core on which the loop runs.
        env={**os.environ, 'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
    )
    compute_beside(process.pid)  # from here, to hold during its imports as well
    return process


def _send(stream: IO[bytes], message: Message) -> None:
    pickle.dump([len(part) for part in message], stream, -1)
    for part in message:
        stream.write(part)
    stream.flush()


def _receive(stream: IO[bytes]) -> list[bytearray]:
    sizes = pickle.load(stream)
    parts = [bytearray(stream.read(size)) for size in sizes]
    if [*map(len, parts)] != sizes:
        raise EOFError
    return parts


# --- in the worker ------------------------------------------------------------------------------


def end_with_parent() -> None:
    """Have the kernel kill this process as soon as the thread that started it ends."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def serve(parent: int, preload: Sequence[str], loops: int) -> None:
    """Compute jobs from the standard input until it is closed or the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    end_with_parent()
    if os.getppid() != parent:
        return  # the parent ended before that call
    results = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # keep what jobs print out of the results
    for name in preload:
        import_module(name)
    # If nothing explains the plant, one search follows another. On average they get this share of a
    # processor for each loop, so that they delay no command.
    share, burst_s = 0.25 * loops, 5.0
    credit_s, since = burst_s, time.monotonic()
    with suppress(EOFError, pickle.UnpicklingError):  # no more jobs
        while True:
            job = _receive(sys.stdin.buffer)
            began = time.process_time()
            _send(results, [_result_of(job)])
            credit_s += share * (time.monotonic() - since)
            since = time.monotonic()
            credit_s = min(credit_s, burst_s) - (time.process_time() - began)
            time.sleep(max(-credit_s / share, 0.0))


def _result_of(job: Message) -> bytes:
    """The pickled result of a pickled job, or a Failure, also if pickling itself fails."""
    try:
        function, args = pickle.loads(job[0], buffers=job[1:])
        return pickle.dumps(function(*args), -1)
    except Exception as error:
        return pickle.dumps(Failure(type(error).__name__), -1)
