"""One joint of an arm as a lone actuator: what concerns it passes, and nothing else."""

import subprocess
import sys
from pathlib import Path

from places import ROOT
from ros_processes import DEADLINE_S, ros_world
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from backlash_ros import topics


def test_outputs_reports_and_commands_of_the_joint_pass_and_no_others(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        probe = world.probe()
        y = probe.collect(topics.PLANT_OUTPUT, Float64)
        applied = probe.collect(topics.APPLIED_CONTROL, Float64)
        commands = probe.collect(topics.JOINT_STATE_COMMANDS, JointState)
        states = probe.publisher(topics.ROBOT_STATES, JointState)
        reports = probe.publisher(topics.APPLIED_JOINT_COMMANDS, JointState)
        control = probe.publisher(topics.CONTROL, Float64)
        node = subprocess.Popen(
            [sys.executable, str(ROOT / 'examples' / 'one_joint.py'), 'elbow'],
            env=world.environment, stdin=subprocess.DEVNULL,
        )
        try:
            probe.wait_until(lambda: all(
                each.get_subscription_count() for each in (states, reports, control)
            ) and probe.node.count_publishers(topics.PLANT_OUTPUT), 'the node')

            def passed() -> bool:
                reports.publish(JointState(name=['waist', 'elbow'], position=[1.0, 0.25]))
                states.publish(JointState(name=['waist'], position=[2.0]))
                states.publish(JointState(name=['elbow', 'waist'], position=[0.5, 3.0]))
                control.publish(Float64(data=0.75))
                return bool(y and applied and commands)

            probe.wait_until(passed, 'all three')
        finally:
            node.terminate()
            code = node.wait(DEADLINE_S)
    assert {message.data for message in y} == {0.5}
    assert {message.data for message in applied} == {0.25}
    assert {(*message.name, *message.position) for message in commands} == {('elbow', 0.75)}
    assert code == 0
