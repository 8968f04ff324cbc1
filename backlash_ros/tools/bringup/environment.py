"""What started processes find around them: variables, and a ROS domain that nobody else uses."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import backlash_ros
from backlash_ros.middleware import prefer_loopback
from backlash_ros.tools.cli import ONE_THREAD, BrokenOffError


def child_environment(log_folder: Path, domain: int | None) -> dict[str, str]:
    """Environment of nodes that report events and are confined to this machine.

    What the user has set stays. domain: ROS_DOMAIN_ID to set, None to leave it alone.
    """
    environment = {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', 'ROS_LOG_DIR': str(log_folder / 'ros'),
        **ONE_THREAD, **with_source(os.environ), 'BACKLASH_ROS_EVENTS': '1',
        'PYTHONUNBUFFERED': '1', **({'ROS_DOMAIN_ID': str(domain)} if domain is not None else {}),
    }
    prefer_loopback(environment)  # for drivers; the nodes of this package do so themselves
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
    foreign = dict(environment)
    foreign.pop('BACKLASH_ROS_EVENTS', None)
    if foreign.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None):
        folders = foreign.pop('LD_LIBRARY_PATH', '').split(os.pathsep)
        kept = [folder for folder in folders if not Path(folder).is_relative_to(sys.prefix)]
        foreign['LD_LIBRARY_PATH'] = os.pathsep.join(filter(None, kept))
    return foreign


@contextmanager
def free_domain() -> Iterator[int]:
    """A ROS_DOMAIN_ID that nobody on this machine uses, reserved as long as the context lasts.

    Domain d has the UDP ports from 7400 + 250 d on, of which participant n takes 10 + 2 n and
    11 + 2 n (RTPS 2.5, 9.6.2). A domain is in use when the port of a participant is taken; a port
    that no participant ever uses reserves it, and the kernel gives that back whatever happens to
    this process. Raises BrokenOffError if all are in use.
    """
    domains = 101  # those that lie below the ports that Linux hands out to others
    # Starting at the process id spreads runs that start at the same moment.
    for i in range(domains):
        domain = 1 + (os.getpid() + i) % domains
        port = 7400 + 250 * domain
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reservation:
            try:
                reservation.bind(('', port + 5))
                # As many participants as the discovery range LOCALHOST looks for.
                for of_participant in range(port + 10, port + 74, 2):
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                        probe.bind(('', of_participant))
            except OSError:
                continue
            yield domain
            return
    raise BrokenOffError(
        f'every ROS_DOMAIN_ID from 1 to {domains} is in use on this machine: set one yourself'
    )
