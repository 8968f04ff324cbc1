"""Many simulated runs on a Dask cluster: the jobs of batch.py, computed by other machines."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import CancelledError
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from backlash_ros.tools.batch import Job, Outcome, run_job
from backlash_ros.tools.cli import BrokenOffError, InputError

if TYPE_CHECKING:
    from distributed import Client

CLUSTER_ANSWER_S = 10.0  # for the scheduler to answer, and for a first worker to be there


def run_on_cluster(jobs: Sequence[Job], address: str, label: str = '') -> list[Outcome]:
    """Outcomes in the order of the jobs, the same as those of batch.run_jobs.

    A run whose worker is lost is given to another one. address: of the scheduler, as tcp://HOST:PORT.
    Raises InputError where there is no such cluster, or one with other libraries; BrokenOffError
    where it ends before the runs do, or a run has ended several workers.
    """
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        raise InputError(
            "--cluster needs Dask, which is not installed: pip install 'backlash_ros[cluster]'"
        ) from None
    # The error below says in one line what the user needs to know.
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=CLUSTER_ANSWER_S, set_as_default=False)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f'--cluster {address}: no scheduler answers ({reason}): start one with '
            '`dask scheduler --host HOST`, and workers with `dask worker tcp://HOST:8786`'
        ) from None
    # disable=None: no bar where stderr is not a terminal.
    with client, tqdm(total=len(jobs), desc=label, unit='run', disable=None) as bar:
        _check_workers(client, address)
        try:
            # Not pure: runs of the same parameters are runs all the same.
            futures = client.map(run_job, jobs, pure=False)
            outcomes = {}
            for future, outcome in as_completed(futures, loop=client.loop, with_results=True):
                outcomes[future.key] = outcome
                bar.update()
            return [outcomes[future.key] for future in futures]
        except (KilledWorker, CancelledError) as error:
            why = 'a run has ended several workers: is there enough memory?' \
                if isinstance(error, KilledWorker) else \
                'the scheduler has ended: start it and simulate again'
            raise BrokenOffError(f'--cluster {address}: {why}') from None


def _check_workers(client: Client, address: str) -> None:
    """Raise InputError unless there are workers, with the libraries of this process."""
    from distributed import TimeoutError as NoWorkerError
    here = libraries()
    try:
        client.wait_for_workers(1, timeout=CLUSTER_ANSWER_S)
        there: dict[str, Any] = client.run(libraries)
    except NoWorkerError:
        raise InputError(
            f'--cluster {address}: no worker within {CLUSTER_ANSWER_S:g} s: start some with '
            f'`dask worker {address}`'
        ) from None
    except ImportError as error:
        raise InputError(
            f'--cluster {address}: a worker says {error}: install the same backlash_ros there'
        ) from None
    for worker, found in there.items():
        if found != here:
            raise InputError(
                f'--cluster {address}: {worker} has {found}, here is {here}: install the same '
                'versions, else the last digits differ'
            )


def libraries() -> dict[str, str]:
    """Versions of the libraries on which the last bit of a result may depend."""
    return {name: version(name) for name in ('numpy', 'scipy')}
