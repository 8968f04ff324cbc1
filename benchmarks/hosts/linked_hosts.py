"""Two hosts on one machine: network namespaces, joined by a veth pair or by cable.py.

Nothing leaves the machine: the namespaces have no other device. Linux and root only.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from hosts.cable import ENDS, READY

CABLE = Path(__file__).with_name('cable.py')
DEVICE = 'eth0'
ADDRESSES = ('10.77.0.1', '10.77.0.2')  # known within the two namespaces alone
COMMAND_S = 20.0  # for a command of `ip`
# Each host has its own memory, too: Fast DDS takes what is shared for the same host.
OWN_MEMORY = ('sh', '-c', 'mount -t tmpfs tmpfs /dev/shm && exec "$@"', 'sh')
# What else runs here is no part of the network: as docs/deployment.md says under Priority.
FIRST = ('chrt', '-f', '1')


class Cable(NamedTuple):
    """What a frame meets on its way, each way."""

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    loss_percent: float = 0.0


class Host(NamedTuple):
    """A network namespace with one address, and that of the other host."""

    namespace: str
    address: str
    peer: str

    def command(self, *command: str) -> list[str]:
        """The command as one that runs on this host."""
        return ['ip', 'netns', 'exec', self.namespace, *FIRST, *OWN_MEMORY, *command]

    def set_link(self, state: str) -> None:
        """Pull the cable, 'down', or plug it in again, 'up'."""
        _ip('-n', self.namespace, 'link', 'set', DEVICE, state)


def why_not() -> str:
    """Why there can be no hosts here, empty if there can."""
    if sys.platform != 'linux' or shutil.which('ip') is None:
        return 'needs Linux with iproute2'
    if os.geteuid() != 0:
        return 'needs root, for network namespaces'
    try:
        with linked_hosts() as (host, _):
            subprocess.run(host.command('true'), check=True, capture_output=True, timeout=COMMAND_S)
    except (subprocess.SubprocessError, OSError) as error:
        said = getattr(error, 'stderr', b'') or str(error).encode()
        return f'network namespaces are not allowed here: {said.decode().strip()}'
    return ''


@contextmanager
def linked_hosts(cable: Cable | None = None) -> Iterator[tuple[Host, Host]]:
    """Two hosts, gone when the context is left; cable: None for a bare veth pair.

    Raises CalledProcessError where `ip` fails.
    """
    names = [f'backlash-{os.getpid()}-{side}' for side in ('a', 'b', 'cable')]
    hosts = [Host(names[0], *ADDRESSES), Host(names[1], *ADDRESSES[::-1])]
    with ExitStack() as stack:
        for host in hosts:
            _namespace(host.namespace, stack)
        if cable is None:
            first, second = hosts
            _ip('link', 'add', DEVICE, 'netns', first.namespace, 'type', 'veth',
                'peer', 'name', DEVICE, 'netns', second.namespace)
        else:
            _namespace(names[2], stack)
            _lay(cable, names[2], hosts, stack)
        for host in hosts:
            _ip('-n', host.namespace, 'addr', 'add', f'{host.address}/24', 'dev', DEVICE)
            for device in (DEVICE, 'lo'):
                _ip('-n', host.namespace, 'link', 'set', device, 'up')
        yield hosts[0], hosts[1]


def _lay(cable: Cable, namespace: str, hosts: Sequence[Host], stack: ExitStack) -> None:
    process = subprocess.Popen(
        ['ip', 'netns', 'exec', namespace, sys.executable, str(CABLE),
         '--delay-ms', str(cable.delay_ms), '--jitter-ms', str(cable.jitter_ms),
         '--loss-percent', str(cable.loss_percent)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )
    stack.callback(_end, process)
    assert process.stdout is not None
    if process.stdout.readline().strip() != READY:
        raise OSError('cable.py has not begun')
    for end, host in zip(ENDS, hosts, strict=True):
        _ip('-n', namespace, 'link', 'set', end, 'netns', host.namespace, 'name', DEVICE)


def _end(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.close()
    try:
        process.wait(COMMAND_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _namespace(name: str, stack: ExitStack) -> None:
    _ip('netns', 'add', name)
    stack.callback(_remove, name)


def _remove(name: str) -> None:
    with suppress(subprocess.SubprocessError):
        _ip('netns', 'del', name)


def _ip(*arguments: str) -> None:
    subprocess.run(['ip', *arguments], check=True, capture_output=True, timeout=COMMAND_S)
