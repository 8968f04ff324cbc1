"""Helpers for tests of the page in the browser: where it is, what it is sent, who listens."""

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from bringup_processes import DEADLINE_S, Session, wait_until

ADDRESS = re.compile(r'http://127\.0\.0\.1:\d+$', re.MULTILINE)
LISTENING = '0A'


def address_of(session: Session) -> str:
    """The address that bringup has printed."""
    wait_until(
        lambda: ADDRESS.search(session.stdout) or session.process.poll() is not None, 'the address'
    )
    found = ADDRESS.search(session.stdout)
    assert found, session.stderr
    return found[0]


def frames(address: str) -> Iterator[dict[str, Any]]:
    """What a page is sent, one answer after the other."""
    known = 0
    while True:
        with urlopen(f'{address}/frame?known={known}', timeout=DEADLINE_S) as response:
            frame = json.load(response)
        known = frame['count']
        yield frame


def listening_addresses(process: int) -> set[str]:
    """Where a process accepts connections of TCP: IPv4 as printed, IPv6 as the kernel has it."""
    inodes = set()
    for descriptor in Path(f'/proc/{process}/fd').iterdir():
        try:
            inodes.add(os.readlink(descriptor).removeprefix('socket:[').rstrip(']'))
        except OSError:
            continue  # closed meanwhile
    addresses = set()
    for table in ('tcp', 'tcp6'):
        for line in Path(f'/proc/{process}/net/{table}').read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and fields[9] in inodes:
                address = fields[1].split(':')[0]
                if table == 'tcp':
                    address = '.'.join(str(byte) for byte in reversed(bytes.fromhex(address)))
                addresses.add(address)
    return addresses
