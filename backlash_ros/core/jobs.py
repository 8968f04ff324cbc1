"""Jobs that a loop has computed, at once or in a process of their own.

A job is a pure function of what it is given. The loop submits one at a time to a channel, and polls
for its result; neither waits for a job.
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
from pathlib import Path
from queue import SimpleQueue
from threading import Event, Thread
from typing import IO, Any, NamedTuple

Job = Callable[..., Any]

LOST = 'lost'  # kind of the failure of a job whose worker died


class Failure(NamedTuple):
    """What comes of a job without a result: the class of its exception, LOST of a dead worker."""

    kind: str


class Channel:
    """At most one job at a time. busy: whether there is one whose result nobody has polled yet."""

    def __init__(self, executor: 'Executor') -> None:
        self.busy = self.closed = False
        self.result: Callable[[], Any] | None = None  # once it is there
        self._executor = executor

    def submit(self, job: Job, *args: Any) -> None:
        """Have job(*args) computed, where there is none under way.

        job: a function at the top level of a module, which changes none of its arguments.
        """
        self.busy = True
        self._executor.begin(self, job, args)

    def poll(self) -> Any:
        """The result of the job, or its Failure, once it is finished; None before."""
        if self.result is None:
            return None
        result, self.result, self.busy = self.result, None, False
        return result()

    def close(self) -> None:
        """Nobody waits for the result of its job any more."""
        self.closed = True


class Executor:
    """Computes jobs for any number of channels, each when it is submitted.

    So simulations, lockstep and tests give the same numbers whenever they are made. restarts: how
    many workers have died so far, where there are any.
    """

    restarts = 0

    def open(self) -> Channel:
        return Channel(self)

    def begin(self, channel: Channel, job: Job, args: tuple[Any, ...]) -> None:
        result: Any
        try:
            result = job(*args)
        except Exception as error:  # whatever it is: the loop goes on without this result
            result = Failure(type(error).__name__)
        channel.result = lambda: result

    def close(self) -> None:
        """End it; jobs that are under way are dropped."""


class WorkerExecutor(Executor):
    """Computes jobs in a worker process, which begins with the first channel.

    One that dies is replaced, and only the job that was under way is lost. It ends with its parent,
    however that ends, and imports nothing of that program but what jobs need. preload: modules that
    it imports at its start, not with its first job. loops: how many it works for. worker: the
    process; pickled jobs go to its standard input, pickled results come from its standard output.
    """

    def __init__(self, preload: Sequence[str] = (), loops: int = 1) -> None:
        self.restarts, self._arguments = 0, (tuple(preload), loops)
        self._submitted: SimpleQueue[tuple[Channel, bytes] | None] = SimpleQueue()
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
        self._submitted.put((channel, pickle.dumps((job, args), -1)))

    def close(self) -> None:
        self._closed.set()
        self._submitted.put(None)
        while self._thread is not None and self._thread.is_alive():
            worker = self.worker
            if worker is not None:
                worker.kill()
            self._thread.join(0.1)

    def _exchange(self) -> None:
        """Have jobs done one by one."""
        deaths = 0  # in a row without an answer
        for channel, job in iter(self._submitted.get, None):
            asked = False
            while not (asked or channel.closed or self._closed.is_set()):
                try:
                    self.worker = self.worker or _start(*self._arguments)
                    assert self.worker.stdin
                    assert self.worker.stdout
                    _send(self.worker.stdin, job)
                    asked = True
                    body = pickle.load(self.worker.stdout)
                    # Not here, where it would keep the loop waiting.
                    channel.result, deaths = partial(pickle.loads, body), 0
                # Of a start: no memory, or no more processes.
                except (OSError, EOFError, pickle.UnpicklingError):
                    self._end_worker()
                    self.restarts, deaths = self.restarts + 1, deaths + 1
                    if asked:
                        channel.result = partial(Failure, LOST)
                    if deaths > 1:  # like the one before it
                        self._closed.wait(min(0.1 * 2.0 ** min(deaths, 7), 10.0))
        self._end_worker()

    def _end_worker(self) -> None:
        worker, self.worker = self.worker, None
        if worker is not None:
            with suppress(OSError), worker:  # of what could not be sent any more
                worker.kill()


def _start(preload: tuple[str, ...], loops: int) -> subprocess.Popen[bytes]:
    code = f'import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; ' \
        f'serve({os.getpid()}, {preload!r}, {loops})'
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


def _send(stream: IO[bytes], body: bytes) -> None:
    """Send what was pickled, as one object to pickle: so it is read as a whole."""
    pickle.dump(body, stream, -1)
    stream.flush()


# --- in the worker ------------------------------------------------------------------------------


def end_with_parent() -> None:
    """Let the kernel end this process with the thread that started it, whatever it does then."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


def serve(parent: int, preload: Sequence[str], loops: int) -> None:
    """Compute jobs that come through the standard input, until it or the parent ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    end_with_parent()
    if os.getppid() != parent:
        return  # it has ended before that
    results = os.fdopen(os.dup(1), 'wb')
    os.dup2(2, 1)  # what a job prints is no result
    for name in preload:
        import_module(name)
    # Where nothing explains what a plant does, one search follows the other. On average they get
    # this share of a processor for each loop, so that no command is late for them.
    share, burst_s = 0.25 * loops, 5.0
    credit_s, since = burst_s, time.monotonic()
    with suppress(EOFError, pickle.UnpicklingError):  # nobody sends another one
        while True:
            job = pickle.load(sys.stdin.buffer)
            began = time.process_time()
            _send(results, _result_of(job))
            credit_s += share * (time.monotonic() - since)
            since = time.monotonic()
            credit_s = min(credit_s, burst_s) - (time.process_time() - began)
            time.sleep(max(-credit_s / share, 0.0))


def _result_of(job: bytes) -> bytes:
    """The pickled result of a job, or Failure; also where job or result cannot be pickled."""
    try:
        function, args = pickle.loads(job)
        return pickle.dumps(function(*args), -1)
    except Exception as error:
        return pickle.dumps(Failure(type(error).__name__), -1)
