"""Simulate seeds and sweeps as jobs, here or on a cluster, and compute their statistics."""

import logging
import multiprocessing
import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import product
from math import inf

import numpy as np
import yaml
from tqdm import tqdm

from backlash_ros.core.jobs import end_with_parent
from backlash_ros.core.parameters import Parameters, Value
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import SETTLING_TOLERANCE
from backlash_ros.tools import cli
from backlash_ros.tools.config import parse_setting
from backlash_ros.tools.runs.read_run import run_loop
from backlash_ros.tools.runs.summary import summarise
from backlash_ros.topics import BACKLASH

CLUSTER_ANSWER_S = 10.0  # timeout for the scheduler to answer, and for a first worker
# Of m, c_r and c_l an outcome has: prefix of the column, and group in a summary.
OUTCOME_GROUPS = {
    '': 'final', 'std_': 'final_std', 'true_': 'truth', 'settling_': 'settling_time_s',
}
OUTCOME_COLUMNS = (
    *(f'{prefix}{name}' for prefix in OUTCOME_GROUPS for name in BACKLASH),
    'control_error_rms', 'tracking_error_rms', 'lost_samples', 'problem',
)
STATISTICS = 'bias', 'RMSE', 'settled, median', 'settled, last', 'within 1 %'
Job = tuple[Parameters, int]  # a run: its parameters and number of samples
# Results of a run by OUTCOME_COLUMNS; problem: why it broke off, '' if it did not.
Outcome = Mapping[str, float | str | None]


def combinations(texts: Sequence[str]) -> list[dict[str, Value]]:
    """All combinations of sweeps `KEY=v1,v2,...` (YAML); the last one varies fastest."""
    sweeps: dict[str, list[Value]] = {}
    for text in texts:
        name, _, listed = map(str.strip, text.partition('='))
        if name in sweeps:
            raise cli.InputError(f'--sweep names {name} twice')
        try:
            values = yaml.safe_load(f'[{listed}]')
        except (yaml.YAMLError, ValueError):
            values = []
        if not values:
            raise cli.InputError(f'--sweep {text!r} must be KEY=v1,v2,... in YAML')
        sweeps[name] = [parse_setting(f'{name}={value}')[-1] for value in values]
    return [dict(zip(sweeps, values, strict=True)) for values in product(*sweeps.values())]


def make_jobs(
    parameters: Parameters, changes: Sequence[Mapping[str, Value]], seeds: Sequence[int],
    duration: float | None,
) -> list[Job]:
    """One job for each change and seed; each combination is built once, to check it."""
    jobs = []
    for change in changes:
        changed = parameters.replaced(change)
        samples = cli.number_of_samples(changed, duration)
        build_closed_loop(changed)
        jobs += [(changed.replaced({'seed': seed}), samples)
                 for seed in ([changed.seed] if 'seed' in change else seeds)]
    return jobs


def run_job(job: Job) -> Outcome:
    """Simulate one run; its outcome says so if it broke off."""
    parameters, samples = job
    try:
        summary = summarise(run_loop(build_closed_loop(parameters), samples), parameters)
    except cli.BrokenOffError as error:
        return {**dict.fromkeys(OUTCOME_COLUMNS), 'problem': str(error)}
    summary |= {f'{prefix}{name}': summary[group][name]
                for prefix, group in OUTCOME_GROUPS.items() for name in BACKLASH}
    return {name: summary.get(name, '') for name in OUTCOME_COLUMNS}


def run_jobs(
    jobs: Sequence[Job], workers: int | None = None, cluster: str | None = None, label: str = '',
) -> list[Outcome]:
    """Run jobs; their outcomes are in order, and do not depend on where they were computed.

    workers: number of processes, one per processor if None; 1 stays in this process. cluster:
    address of a Dask scheduler, whose workers are used instead.
    """
    workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
    finished = _on_cluster(jobs, cluster) if cluster is not None else \
        _in_processes(jobs, workers) if workers > 1 else map(run_job, jobs)
    return list(tqdm(finished, desc=label, total=len(jobs), unit='run', disable=None))


def _in_processes(jobs: Sequence[Job], workers: int) -> Iterator[Outcome]:
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context('spawn'), initializer=end_with_parent)
    try:
        # A signal while workers start takes effect afterwards, whichever thread gets it.
        with cli.StopRequests() as held:
            # Workers inherit the blocked signals for good: Ctrl-C is for their parent alone.
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            outcomes = [executor.submit(run_job, job) for job in jobs]
            signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        if held.count:
            raise KeyboardInterrupt
        for outcome in outcomes:
            # A signal just before a wait, or in another thread, is noticed only after it.
            while not wait([outcome], timeout=0.2).done:
                pass
            yield outcome.result()
    except BrokenProcessPool:
        raise cli.BrokenOffError('a worker process was killed: is there enough memory?') from None
    finally:
        for worker in multiprocessing.active_children():
            worker.kill()  # it has nothing to save
        executor.shutdown(cancel_futures=True)


def _on_cluster(jobs: Sequence[Job], address: str) -> Iterator[Outcome]:
    """Run jobs on a cluster; a job of a lost worker goes to another. address: tcp://HOST:PORT."""
    try:
        from distributed import Client, KilledWorker, TimeoutError
    except ImportError:
        raise cli.InputError(
            '--cluster needs Dask, which is not installed: pip install distributed'
        ) from None
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    try:
        with Client(address, timeout=CLUSTER_ANSWER_S, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=CLUSTER_ANSWER_S)
            # Not pure: Dask is not to merge runs with the same parameters.
            for future in client.map(run_job, jobs, pure=False):
                yield future.result()
    except (KilledWorker, CancelledError):
        raise cli.BrokenOffError(f'--cluster {address}: a run has ended several workers, or the '
                             'scheduler has ended: is there enough memory?') from None
    except (OSError, ValueError, ImportError, TimeoutError) as error:
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise cli.InputError(
            f'--cluster {address}: {reason}: start a scheduler with `dask scheduler --host HOST`, '
            'and workers that have this backlash_ros with `dask worker tcp://HOST:8786`'
        ) from None


def statistics(outcomes: Sequence[Outcome]) -> dict[str, tuple[float, ...]]:
    """STATISTICS of each estimate over the runs that did not break off.

    Settling times in s, inf for never. Raises InputError if all broke off.
    """
    whole = [outcome for outcome in outcomes if not outcome['problem']]
    if not whole:
        raise cli.InputError(f'every run broke off, the first one with: {outcomes[0]["problem"]}')
    found = {}
    for name in BACKLASH:
        final, truth, settling = (np.array([one[f'{prefix}{name}'] for one in whole], dtype=float)
                                  for prefix in ('', 'true_', 'settling_'))
        error, settling = final - truth, np.sort(np.where(np.isnan(settling), inf, settling))
        found[name] = tuple(map(float, (
            error.mean(), np.sqrt(np.mean(error**2)),
            # The median of a number and "never" is never, not the nan of inf - inf.
            settling[len(whole) // 2], settling[-1],
            np.mean(np.abs(error) <= SETTLING_TOLERANCE * np.abs(truth)))))
    return found
