"""The driver of bus servos beside an emulated bus: messages, silence, a pulled plug, the end.

Ten minutes at 100 Hz, with the counts: BUS_RATE=100 BUS_CYCLES=60000 pytest -s --timeout=0.
"""

import math
import os
import re
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

pytest.importorskip('mujoco', reason='the physics need mujoco (requirements/dev.txt)')
pytest.importorskip('dynamixel_sdk', reason='the bus needs dynamixel-sdk (requirements/dev.txt)')

from arm_physics import JOINTS, ArmPhysics
from places import ROOT
from ros_processes import ros_world
from sensor_msgs.msg import JointState
from servo_bus import CENTRE, GOAL, POSITION, RESOLUTION, TORQUE_ENABLE, EmulatedBus, Port
from std_msgs.msg import Float64MultiArray
from waiting import DEADLINE_S

NAMES = [joint.name for joint in JOINTS]
SPEED, RATE = 2.0, float(os.environ.get('BUS_RATE', '50'))  # [rad/s], [Hz]
CYCLES = int(os.environ.get('BUS_CYCLES', '0'))  # at least, before the end
MOST = math.ceil(SPEED * 2.0 / RATE / RESOLUTION)  # steps at once


class WatchedBus(EmulatedBus):
    """Remembers how far a goal under torque was from the one before and from where the joint was.

    A servo is engaged where it stands, even where that is not where it was told to go.
    """

    largest = 0

    def _write(self, number: int, parameters: bytes) -> int:
        servo = self.servos[number]
        near = [servo.get(POSITION)] + [servo.get(GOAL)] * servo.get(TORQUE_ENABLE)
        error = super()._write(number, parameters)
        if servo.get(TORQUE_ENABLE):
            step = min(abs(servo.get(GOAL) - place) for place in near)
            self.largest = max(self.largest, step)
        return error


class World:
    """The driver as a process, a bus behind a link, and a node that speaks with the driver."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.world = stack.enter_context(ros_world(folder))
        self.bus, self.link, self.log = WatchedBus(ArmPhysics()), folder / 'port', folder / 'log'
        self.probe = self.world.probe()
        self.heard = self.probe.collect('robot_joint_states', JointState)
        self.applied = self.probe.collect('applied_joint_commands', JointState)
        self.array = self.probe.publisher('forward_command_controller/commands', Float64MultiArray)
        self.by_name = self.probe.publisher('joint_commands', JointState)
        ids = [f'{name}={i + 1}' for i, name in enumerate(NAMES)]
        self.driver = subprocess.Popen(
            [sys.executable, str(ROOT / 'examples' / 'bus_servo_driver.py'), '--port',
             str(self.link), '--rate', str(RATE), '--speed', str(SPEED), '--patience', '300',
             '--joints', *ids],
            env=self.world.environment, stderr=self.log.open('wb'), stdin=subprocess.DEVNULL)
        stack.callback(self.driver.wait)
        stack.callback(self.driver.kill)
        self.probe.wait_until(
            lambda: self.by_name.get_subscription_count() and self.array.get_subscription_count(),
            'the driver')
        self.port = Port(self.bus, self.link)  # no cycle before was a complete one
        stack.callback(lambda: self.port.close())
        self.probe.wait_until(lambda: self.heard and self.applied, 'the bus')

    def told(self, positions: list[float]) -> bool:
        """Command all joints; returns whether all were told to go there, and are there."""
        self.array.publish(Float64MultiArray(data=positions))
        lost = max(self.bus.arm.lost_motion(joint) for joint in JOINTS)
        return (
            list(self.applied[-1].position) == pytest.approx(positions, abs=RESOLUTION)
            and list(self.heard[-1].name) == NAMES
            and list(self.heard[-1].position) == pytest.approx(positions, abs=lost))

    def stop(self) -> str:
        self.driver.terminate()
        assert self.driver.wait(DEADLINE_S) == 0, self.log.read_text()
        return self.log.read_text()


def test_joints_follow_through_silence_and_a_pulled_plug_and_are_limp_at_the_end(tmp_path):
    with ExitStack() as stack:
        arm = World(tmp_path, stack)
        def await_log(words: str) -> None:
            arm.probe.wait_until(lambda: words in arm.log.read_text(), words)
        goals = [0.3, -0.2, 0.25, 0.5, -0.4, 0.35]
        arm.probe.wait_until(lambda: arm.told(goals), 'the arm')
        # Names in another order, one that is nobody's, one without a position; the others stay.
        message = JointState(name=['elbow', 'nobody', 'waist', 'shoulder'],
                             position=[0.1, 1.0, -0.1, math.nan])
        expected = [-0.1, -0.2, 0.1, 0.5, -0.4, 0.35]
        def went() -> bool:
            arm.by_name.publish(message)
            return list(arm.applied[-1].position) == pytest.approx(expected, abs=RESOLUTION)
        arm.probe.wait_until(went, 'the named joints')
        arm.bus.dead.add(2)
        others = [name for name in NAMES if name != 'shoulder']
        arm.probe.wait_until(lambda: arm.heard[-1].name == others, 'messages without the joint')
        await_log('shoulder is silent')
        arm.bus.dead.clear()
        arm.probe.wait_until(lambda: arm.told([0.1] * 6), 'all joints')
        arm.port.close()
        await_log('waist is silent')
        arm.port = Port(arm.bus, arm.link)
        arm.probe.wait_until(lambda: arm.told([-0.3] * 6), 'all joints')
        for cycle in range(len(arm.heard), CYCLES):
            arm.array.publish(Float64MultiArray(data=[0.3 * math.sin(0.01 * cycle)] * 6))
            arm.probe.wait_until(lambda end=cycle: len(arm.heard) > end, 'the next cycle')
        arm.probe.wait_until(lambda: arm.told([-0.3] * 6), 'all joints')
        log = arm.stop()
        found = re.search(r'(\d+) cycles, (\d+) of them lost; torque is off$', log, re.MULTILINE)
        assert found
        print(found[0])
        cycles, lost = map(int, found.groups())
        def complete() -> int:
            return sum(len(message.name) == len(NAMES) for message in arm.heard)
        arm.probe.wait_until(lambda: complete() >= cycles - lost - 5, 'what was not lost')
    assert arm.bus.largest <= MOST
    assert 0 < lost < cycles
    assert complete() <= cycles - lost
    servos = arm.bus.servos.values()
    assert [servo.get(TORQUE_ENABLE) for servo in servos] == [0] * 6
    assert {servo.get(GOAL) for servo in servos} == {CENTRE + round(-0.3 / RESOLUTION)}
