"""The environment of the processes that are started."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from pathlib import Path

import backlash_ros
from backlash_ros.middleware.loopback import prefer_loopback

# Set by ROS 2 wheels when they have prepared LD_LIBRARY_PATH for the Python that runs.
WHEELS_MARK, LIBRARY_PATH = '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'LD_LIBRARY_PATH'


def child_environment(log_folder: Path, domain: int | None) -> dict[str, str]:
    """Environment of nodes that report events and are confined to this machine.

    What the user has set stays. domain: ROS_DOMAIN_ID to set, None to leave it alone.
    """
    environment = with_source(os.environ)
    environment['BACKLASH_ROS_EVENTS'] = '1'
    environment['PYTHONUNBUFFERED'] = '1'
    if domain is not None:
        environment['ROS_DOMAIN_ID'] = str(domain)
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    prefer_loopback(environment)  # for drivers; the nodes of this package do so themselves
    environment.setdefault('ROS_LOG_DIR', str(log_folder / 'ros'))
    # The matrices are tiny: more threads would only take the processors from each other.
    for name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        environment.setdefault(name, '1')
    return environment


def with_source(environment: Mapping[str, str]) -> dict[str, str]:
    """A copy in which Python finds this package, which need not be installed."""
    source = str(Path(backlash_ros.__file__).resolve().parents[1])
    # Behind the user's own entries it shadows nothing.
    paths = [entry for entry in environment.get('PYTHONPATH', '').split(os.pathsep) if entry]
    return {**environment, 'PYTHONPATH': os.pathsep.join([*paths, source])}


def foreign_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The same for a program that is no node of this package and may be of another Python.

    ROS 2 wheels have set variables for this Python alone, with which those of another one fail.
    """
    foreign = {
        name: value for name, value in environment.items()
        if name not in ('BACKLASH_ROS_EVENTS', WHEELS_MARK)
    }
    if WHEELS_MARK in environment and LIBRARY_PATH in environment:
        folders = environment[LIBRARY_PATH].split(os.pathsep)
        kept = [folder for folder in folders if not Path(folder).is_relative_to(sys.prefix)]
        foreign[LIBRARY_PATH] = os.pathsep.join(kept)
        if not kept:
            del foreign[LIBRARY_PATH]
    return foreign
