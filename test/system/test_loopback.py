"""Which way messages go between nodes of one machine."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from ros_processes import ros_world
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.middleware.loopback import (
    NETWORK_PROFILE,
    OF_THE_FOLDER,
    PROFILE,
    VARIABLE,
    prefer_loopback,
)
from backlash_ros.tools.bringup.environment import DOMAIN_0_PORT, PORTS_PER_DOMAIN

HERE = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
MAPS = Path('/proc/self/maps')  # Linux
SHARED_MEMORY = Path('/dev/shm')  # Linux
PORT_SIZE = 52400  # of the file that Fast DDS makes for a port, in bytes
PORTS_OF_TEN_PROCESSES = 32


def chosen(environment: dict[str, str]) -> str | None:
    prefer_loopback(environment)
    return environment.get(VARIABLE)


def test_profile_is_taken_where_nobody_else_is_to_be_met() -> None:
    assert chosen({**HERE}) == str(PROFILE)
    assert PROFILE.is_file()


def test_named_machines_are_reached_with_the_profile_of_the_network() -> None:
    assert chosen({**HERE, 'ROS_STATIC_PEERS': '192.168.0.2'}) == str(NETWORK_PROFILE)
    assert NETWORK_PROFILE.is_file()


@pytest.mark.parametrize('environment', [{}, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}])
def test_other_machines_stay_within_reach(environment: dict[str, str]) -> None:
    assert chosen(environment) is None


def test_a_profile_of_the_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen({**HERE, VARIABLE: 'own.xml'}) == 'own.xml'
    monkeypatch.chdir(tmp_path)
    (tmp_path / OF_THE_FOLDER).touch()
    assert chosen({**HERE}) is None


@pytest.mark.skipif(not MAPS.exists(), reason='processes are not to be looked into')
def test_nodes_share_no_port_that_a_killed_one_could_damage(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        reference = world.start('reference', {'wait_for_subscribers': 1})
        probe = world.probe()
        heard = probe.collect(topics.REFERENCE, Float64)
        probe.wait_until(lambda: heard, 'reference')
        assert 'fastrtps_port' not in Path(f'/proc/{reference.process.pid}/maps').read_text()
        assert reference.stop() == 0
    assert 'Error' not in reference.stderr


@pytest.mark.skipif(not SHARED_MEMORY.is_dir(), reason='no shared memory as on Linux')
def test_node_starts_where_a_killed_one_has_left_its_port_half_made(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world, ExitStack() as stack:
        first = DOMAIN_0_PORT + PORTS_PER_DOMAIN * world.domain
        for number in range(first, first + PORTS_OF_TEN_PROCESSES):
            port = SHARED_MEMORY / f'fastrtps_port{number}'
            if not port.exists():
                # Without the profile Fast DDS waits for ever until somebody completes it.
                port.write_bytes(bytes(PORT_SIZE))
                stack.callback(port.unlink, missing_ok=True)
        reference = world.start('reference', {'wait_for_subscribers': 0})
        reference.wait_for('ready')
        assert reference.stop() == 0
