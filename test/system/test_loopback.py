"""Nodes of one machine do without shared memory, which a killed one could leave damaged."""

from contextlib import ExitStack
from pathlib import Path

import pytest
from ros_processes import ros_world
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.tools.bringup.environment import DOMAIN_0_PORT, PORTS_PER_DOMAIN

SHARED_MEMORY = Path('/dev/shm')  # Linux
PORT_SIZE = 52400  # of the file that Fast DDS makes for a port, in bytes
PORTS_OF_TEN_PROCESSES = 32


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason='no shared memory as on Linux')
def test_nodes_meet_where_a_killed_one_has_left_its_port_half_made(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world, ExitStack() as stack:
        first = DOMAIN_0_PORT + PORTS_PER_DOMAIN * world.domain
        for number in range(first, first + PORTS_OF_TEN_PROCESSES):
            port = SHARED_MEMORY / f'fastrtps_port{number}'
            if not port.exists():
                # Without the profile Fast DDS waits for ever until somebody completes it.
                port.write_bytes(bytes(PORT_SIZE))
                stack.callback(port.unlink, missing_ok=True)
        reference = world.start('reference', {'wait_for_subscribers': 1})
        probe = world.probe()
        heard = probe.collect(topics.REFERENCE, Float64)
        probe.wait_until(lambda: heard, 'reference')
        assert 'fastrtps_port' not in Path(f'/proc/{reference.process.pid}/maps').read_text()
        assert reference.stop() == 0
    assert 'Error' not in reference.stderr
