"""What killed processes leave in shared memory."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from ros_processes import ros_world

from backlash_ros.stale_ports import MAKING_TAKES_S, SHARED_MEMORY, remove_stale_ports
from backlash_ros.tools.processes import DOMAIN_0_PORT, PORTS_PER_DOMAIN

SIZE = 52400  # of the file of a port
HALF_MADE, COMPLETE = bytes(SIZE), b'\x02' + bytes(SIZE - 1)
FIRST_USER_PORT = 11  # of a domain
# Nodes of other tests that start at the same moment may be first to remove what is left.
ATTEMPTS = 5


def leave(path: Path, content: bytes, age_s: float = MAKING_TAKES_S + 1.0) -> Path:
    path.write_bytes(content)
    then = time.time() - age_s
    os.utime(path, (then, then))
    return path


@pytest.mark.parametrize('content', [HALF_MADE, b'\x01' + bytes(99), b''])
def test_half_made_port_is_removed(tmp_path: Path, content: bytes) -> None:
    port = leave(tmp_path / 'fastrtps_port26415', content)
    (line,) = remove_stale_ports(tmp_path)
    assert not port.exists()
    assert line.startswith(f'{port}: removed')


@pytest.mark.parametrize(('name', 'content', 'age_s'), [
    ('fastrtps_port26415', COMPLETE, 1e6),
    ('fastrtps_port26415', HALF_MADE, 0.0),  # being made at this moment
    ('fastrtps_port26415_el', b'', 1e6),  # a lock, always empty
    ('fastrtps_00380f10ddeae7a6', HALF_MADE, 1e6),
])
def test_everything_else_stays(tmp_path: Path, name: str, content: bytes, age_s: float) -> None:
    port = leave(tmp_path / name, content, age_s)
    assert remove_stale_ports(tmp_path) == []
    assert port.exists()


def test_folder_that_is_not_there_holds_none(tmp_path: Path) -> None:
    assert remove_stale_ports(tmp_path / 'none') == []


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason='no shared memory as on Linux')
def test_node_starts_where_a_killed_one_has_left_its_port_half_made(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        number = DOMAIN_0_PORT + PORTS_PER_DOMAIN * world.domain + FIRST_USER_PORT
        port = SHARED_MEMORY / f'fastrtps_port{number}'
        for _ in range(ATTEMPTS):
            port.unlink(missing_ok=True)
            leave(port, HALF_MADE)
            reference = world.start('reference', {'wait_for_subscribers': 0})
            reference.wait_for('ready')
            assert reference.stop() == 0
            if f'{port}: removed' in reference.stderr:
                return
    pytest.fail(f'the node does not say that it has removed {port}:\n{reference.stderr}')
