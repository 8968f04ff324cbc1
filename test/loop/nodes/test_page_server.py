"""The server of the live page: readers that are slow, or come late."""

import json
import socket
import threading
from collections.abc import Iterator

import pytest
from live_pages import frames

from backlash_ros.nodes.live import HOST, PageServer


@pytest.fixture
def served() -> Iterator[PageServer]:
    server = PageServer(0, kept=3)
    threading.Thread(target=server.serve_forever, kwargs={'poll_interval': 0.01}).start()
    yield server
    server.shutdown()
    server.server_close()


def test_a_reader_that_takes_nothing_holds_up_nobody(served):
    # More than the kernel takes on the way.
    served.add({'x': 'x' * 20_000_000}, {})
    with socket.create_connection(served.server_address[:2]) as slow:
        slow.sendall(f'GET /frame HTTP/1.1\r\nHost: {HOST}\r\n\r\n'.encode())
        slow.recv(1, socket.MSG_PEEK)
        for number in range(20):
            served.add({'number': number}, {})
            assert next(frames(served.address))['state'] == {'number': number}


def test_a_reader_gets_the_newest_portions_and_each_of_them_once(served):
    for k in range(5):
        served.add({}, {'c': {'m': [float(k)]}})
    seen = frames(served.address)
    assert [portion['c']['m'] for portion in next(seen)['portions']] == [[2.0], [3.0], [4.0]]
    served.add({}, {'c': {'m': [5.0]}})
    assert [portion['c']['m'] for portion in next(seen)['portions']] == [[5.0]]
    assert next(seen)['portions'] == []
    # Who has seen more than there ever was has seen another server.
    assert len(json.loads(served.frame(99))['portions']) == 3
