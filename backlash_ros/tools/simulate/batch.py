"""Many simulated runs in parallel processes: seeds and sweeps."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf, isfinite, nan

import yaml
from tqdm import tqdm

from backlash_ros.core.parameters import Parameters, check_names, check_value
from backlash_ros.core.parameters.table import BY_NAME, Value
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.options import FAILED
from backlash_ros.tools.cli.command_line import number_of_samples
from backlash_ros.tools.cli.errors import BrokenOffError, InputError
from backlash_ros.tools.run_files.results import summarise
from backlash_ros.tools.simulate.simulation import run_loop
from backlash_ros.topics import BACKLASH

PATIENCE_S = 5.0  # after an interruption, until the process ends whatever it waits for
# The matrices are tiny: threads of the linear algebra would only disturb the other processes.
ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')


@dataclass(frozen=True)
class Sweep:
    """A parameter and the values it takes in turn."""

    name: str
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Job:
    """One run: its complete parameters and its length."""

    values: Mapping[str, Value]
    samples: int


@dataclass(frozen=True)
class Outcome:
    """Last estimates of (m, c_r, c_l), what they should be, and what else a run came to.

    std: nan where the law has none. settling [s]: inf for never. problem: why a run broke off,
    all its numbers are nan then.
    """

    final: tuple[float, ...] = (nan, nan, nan)
    std: tuple[float, ...] = (nan, nan, nan)
    truth: tuple[float, ...] = (nan, nan, nan)
    settling: tuple[float, ...] = (nan, nan, nan)
    control_error_rms: float = nan
    tracking_error_rms: float = nan
    lost_samples: int = 0
    problem: str = ''


def parse_sweep(text: str) -> Sweep:
    """Return the sweep of `KEY=v1,v2,...`; the values are written as in a YAML list."""
    name, equals, listed = text.partition('=')
    name = name.strip()
    if not equals or not listed.strip():
        raise InputError(f'--sweep {text!r} must be KEY=v1,v2,...')
    check_names([name])
    try:
        values = yaml.safe_load(f'[{listed}]')
    except yaml.YAMLError:
        raise InputError(f'--sweep {text!r}: the values are no list in YAML') from None
    if isinstance(BY_NAME[name].default, str):
        values = [str(value) for value in values]
    return Sweep(name, tuple(check_value(BY_NAME[name], value) for value in values))


def combinations(sweeps: Sequence[Sweep]) -> list[dict[str, Value]]:
    """Every combination of the swept values, the last one changing fastest."""
    names = [sweep.name for sweep in sweeps]
    if len(set(names)) < len(names):
        raise InputError(f'--sweep names {max(names, key=names.count)} twice')
    return [
        dict(zip(names, values, strict=True))
        for values in itertools.product(*(sweep.values for sweep in sweeps))
    ]


def value_text(value: Value) -> str:
    """A parameter value as short text."""
    if isinstance(value, tuple):
        return '[' + ', '.join(f'{element:g}' for element in value) + ']'
    return f'{value:g}' if isinstance(value, float) else str(value)


def make_jobs(
    parameters: Parameters, changes: Sequence[Mapping[str, Value]], seeds: Sequence[int],
    duration: float | None,
) -> list[Job]:
    """One job for each change and, within it, each seed (its own if it changes the seed).

    Every combination is built once, so that a bad one is refused before anything starts.
    """
    jobs = []
    for change in changes:
        changed = parameters.replaced(change)
        samples = number_of_samples(changed, duration)
        build_closed_loop(changed)
        own = [changed.get_int('seed')] if 'seed' in change else seeds
        jobs += [Job(dict(changed.replaced({'seed': seed})), samples) for seed in own]
    return jobs


def run_job(job: Job) -> Outcome:
    """Simulate one run; a run that breaks off is an outcome too."""
    parameters = Parameters(job.values)
    try:
        run = run_loop(build_closed_loop(parameters), job.samples)
    except BrokenOffError as error:
        return Outcome(problem=str(error))
    summary = summarise(run, parameters)
    settling = summary['settling_time_s']
    control_error, tracking_error = summary['control_error_rms'], summary['tracking_error_rms']
    return Outcome(
        final=tuple(summary['final'][name] for name in BACKLASH),
        std=tuple(summary['final_std'][name] for name in BACKLASH),
        truth=tuple(summary['truth'][name] for name in BACKLASH),
        settling=tuple(inf if settling[name] is None else settling[name] for name in BACKLASH),
        control_error_rms=nan if control_error is None else control_error,
        tracking_error_rms=nan if tracking_error is None else tracking_error,
        lost_samples=summary['lost_samples'],
    )


def run_jobs(jobs: Sequence[Job], workers: int | None = None, label: str = '') -> list[Outcome]:
    """Outcomes in the order of the jobs, whatever the number of processes.

    workers: None takes one process per processor, 1 none besides this one. Call it from the main
    thread, which alone is told of signals.
    """
    if workers is None:
        workers = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else (
            os.cpu_count() or 1)
    workers = min(workers, len(jobs))
    # disable=None: no bar where stderr is not a terminal.
    with tqdm(total=len(jobs), desc=label, unit='run', disable=None) as bar:
        if workers <= 1:
            outcomes = []
            for job in jobs:
                outcomes.append(run_job(job))
                bar.update()
            return outcomes
        with _pool(workers) as pool:
            with _signals_held_back():
                futures = {pool.submit(run_job, job): i for i, job in enumerate(jobs)}
            by_index = {}
            for future in as_completed(futures):
                by_index[futures[future]] = future.result()
                bar.update()
        return [by_index[i] for i in range(len(jobs))]


@contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Spawned workers, killed when the caller is interrupted: they have nothing to save."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)  # read when a worker imports numpy
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        workers, multiprocessing.get_context('spawn'), initializer=_end_with_parent
    )
    try:
        yield pool
    except BrokenProcessPool:
        raise BrokenOffError('a worker process was killed: is there enough memory?') from None
    except BaseException as error:
        for worker in set(multiprocessing.active_children()) - others:
            worker.kill()
        if isinstance(error, KeyboardInterrupt):
            # The thread of the pool may wait for ever for a worker that was killed as it began.
            pool.shutdown(wait=False, cancel_futures=True)
            leave = threading.Timer(PATIENCE_S, os._exit, (FAILED,))
            leave.daemon = True
            leave.start()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Let no signal cut short the start of a worker; one that came is raised afterwards."""
    held: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    # A handler, as a signal blocked in this thread reaches Python through any other one.
    handlers = {number: signal.signal(number, lambda n, _: held.append(n)) for number in numbers}
    # Blocked as well, which workers inherit for good: Ctrl-C is for their parent alone.
    signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, numbers)
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if held:
        raise KeyboardInterrupt


def _end_with_parent() -> None:
    """Let this worker end when its parent does, of whatever cause."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def outcome_header(swept: Sequence[str]) -> list[str]:
    """Columns of seeds.csv and sweep.csv."""
    return [
        *swept, 'seed', *BACKLASH, *(f'std_{name}' for name in BACKLASH),
        *(f'true_{name}' for name in BACKLASH), *(f'settling_{name}' for name in BACKLASH),
        'control_error_rms', 'tracking_error_rms', 'lost_samples', 'problem',
    ]


def outcome_row(swept: Sequence[str], job: Job, outcome: Outcome) -> list[object]:
    """Row of one run, with nothing where a number is unknown or never reached."""
    return [
        *(_plain(job.values[name]) for name in swept), job.values['seed'],
        *outcome.final, *outcome.std, *outcome.truth,
        *(time if isfinite(time) else None for time in outcome.settling),
        outcome.control_error_rms, outcome.tracking_error_rms, outcome.lost_samples,
        outcome.problem,
    ]


def _plain(value: Value) -> object:
    return list(value) if isinstance(value, tuple) else value
