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
    known = 0
    while True:
        with urlopen(f'{address}/frame?known={known}', timeout=DEADLINE_S) as response:
            frame = json.load(response)
        known = frame['count']
        yield frame


def listening_addresses(process: int) -> set[str]:
    return {each.laddr.ip for each in psutil.Process(process).net_connections('tcp')
            if each.status == psutil.CONN_LISTEN}
