"""Helpers for tests of the page in the browser: where it is, what it is sent, who listens."""

import json
import re
from collections.abc import Iterator
from typing import Any
from urllib.request import urlopen

import psutil
from bringup_processes import DEADLINE_S, Session, wait_until

ADDRESS = re.compile(r'http://127\.0\.0\.1:\d+$', re.MULTILINE)


def address_of(session: Session) -> str:
    wait_until(
        lambda: ADDRESS.search(session.stdout) or session.process.poll() is not None, 'the address')
    found = ADDRESS.search(session.stdout)
    assert found, session.stderr
    return found[0]


def frames(address: str) -> Iterator[dict[str, Any]]:
    with urlopen(f'{address}/frames', timeout=DEADLINE_S) as response:
        for line in response:
            if line.startswith(b'data: '):
                yield json.loads(line.removeprefix(b'data: '))


def listening_addresses(process: int) -> set[str]:
    return {each.laddr.ip for each in psutil.Process(process).net_connections('tcp')
            if each.status == psutil.CONN_LISTEN}
