"""The stand-in for ros2_control's topic hardware: when it commands, and what it takes in."""

import math

import pytest
from joint_trajectory import TopicSystem
from sensor_msgs.msg import JointState


def system(**states: float) -> TopicSystem:
    made = TopicSystem(['a', 'b'])
    made.read(JointState(name=list(states), position=list(states.values())))
    return made


def test_nan_is_commanded_until_states_and_commands_are_known() -> None:
    unknown = system(a=0.5)
    message = unknown.write()
    assert list(message.name) == ['a', 'b']
    assert all(map(math.isnan, message.position))
    unknown.commands = {'a': 0.5, 'b': 0.0}
    assert list(unknown.write().position) == [0.5, 0.0]  # b has no state yet


@pytest.mark.parametrize(('differences', 'published'), [
    ((0.0, 0.0), False), ((4e-6, -4e-6), False), ((6e-6, -6e-6), True), ((0.0, 0.1), True),
])
def test_all_joints_are_commanded_where_their_differences_add_up_to_more_than_the_threshold(
    differences: tuple[float, float], published: bool,
) -> None:
    known = system(b=0.25, a=0.5)
    known.commands = {'a': 0.5 + differences[0], 'b': 0.25 + differences[1]}
    message = known.write()
    assert (message is not None) == published
    if published:
        assert list(message.position) == list(known.commands.values())
        assert known.write() is not None  # again, as long as the joints are elsewhere
