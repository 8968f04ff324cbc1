"""One loop for `ros2 launch`: controller, reference, plant or a driver, a recorder if wanted."""

import shlex
from pathlib import Path

from launch import Action, LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from backlash_ros.options import DEFAULT_CONFIG, find_config

ARGUMENTS = {
    'config': (DEFAULT_CONFIG, 'parameter file, or the name of a shipped one'),
    'driver': ('', 'command of your driver; none: it is started elsewhere; empty: simulated plant'),
    'namespace': ('', 'of all nodes but a driver of your own, which needs it in its command'),
    'record': ('', 'folder of the bag, which must not exist yet; empty: nothing is recorded'),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments first, as `ros2 launch --show-args` shows them."""
    return LaunchDescription([
        *(
            DeclareLaunchArgument(name, default_value=default, description=text)
            for name, (default, text) in ARGUMENTS.items()
        ),
        OpaqueFunction(function=actions),
    ])


def actions(context: LaunchContext) -> list[Action]:
    """The processes. The end of one of them, or of the driver, ends all."""
    config, driver, namespace, record = (
        LaunchConfiguration(name).perform(context) for name in ARGUMENTS
    )
    file = str(find_config(Path(config)))

    def node(executable: str, **parameters: str) -> Node:
        return Node(
            package='backlash_ros', executable=executable, namespace=namespace, output='screen',
            parameters=[file, parameters] if parameters else [file], on_exit=Shutdown(),
        )

    found: list[Action] = [node('controller'), node('reference')]
    if record:
        found.append(node('recorder', bag=record))
    if not driver:
        found.append(node('plant'))
    elif driver != 'none':
        found.append(
            ExecuteProcess(cmd=shlex.split(driver), output='screen', on_exit=Shutdown())
        )
    return found
