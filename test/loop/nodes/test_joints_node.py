"""A controller node with several joints, in simulated time: what one of them does to the others."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import nan
from typing import Any

import pytest
from node_in_process import START_NS, node_with
from rclpy.parameter import Parameter

from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.tools.bringup.supervisor import free_domain

JOINTS = ('waist', 'elbow', 'gripper')
AT_ZERO = dict.fromkeys(JOINTS, 0.0)
PERIOD_NS = 20_000_000
ARM: dict[str, object] = {
    'joints': list(JOINTS), 'io.style': 'joint_state_topic', 'sample_period': 0.02,
    'estimator.law': 'fixed', 'control.rate_max': 50.0, 'control.min': -3.0, 'control.max': 3.0,
    'waist.control.max': 2.0, 'timeout.plant_output': 3600.0, 'autostart': False,
}


class Arm:
    """The node, and what it commanded: a message per entry."""

    def __init__(self, node: Any) -> None:
        self.node = node
        self.sent: list[dict[str, float]] = []
        self._k = 0
        io = node._io
        io.publish = lambda commands: self.sent.append(dict(commands))
        io.now_ns = lambda: START_NS + PERIOD_NS * self._k + 1_000_000
        node.trigger_configure()
        node.trigger_activate()

    def hear(self, y: Mapping[str, float]) -> list[str]:
        self._k += 1
        before, stamp_ns, arrived = len(self.sent), START_NS + PERIOD_NS * self._k, time.time_ns()
        self.node._on_output({
            joint: Output(value, stamp_ns, arrived, arrived, self._k, numbered=False)
            for joint, value in y.items()})
        return [joint for commands in self.sent[before:] for joint in commands]

    def commanded(self, y_m: float) -> dict[str, float]:
        self.node._on_reference(dict.fromkeys(JOINTS, y_m))
        for _ in range(10):
            self.hear(AT_ZERO)
        return self.sent[-1]

    def change(self, name: str, value: float) -> str:
        result = self.node.set_parameters_atomically([Parameter(name, value=value)])
        return '' if result.successful else str(result.reason)

    def lose(self, joint: str) -> None:
        self.node.loops.by_name[joint].heard.y_at = -1e9
        self.node._look_for_silence()


@contextmanager
def arm(**changes: object) -> Iterator[Arm]:
    values = {**ARM, **{name.replace('__', '.'): value for name, value in changes.items()}}
    with free_domain() as domain, node_with(values, domain) as node:
        yield Arm(node)


def test_live_parameters_reach_one_joint_or_all_that_have_none_of_their_own() -> None:
    with arm() as made:
        assert min(made.commanded(1.0).values()) > 0.9
        assert made.change('waist.control.max', 0.25) == ''
        assert made.commanded(1.0)['waist'] == 0.25
        assert min(made.commanded(1.0)[joint] for joint in JOINTS[1:]) > 0.9
        assert made.change('control.max', 0.5) == ''
        assert made.commanded(1.0) == {'waist': 0.25, 'elbow': 0.5, 'gripper': 0.5}
        assert 'control.max' in made.change('waist.control.max', -9.0)
        assert made.commanded(1.0)['waist'] == 0.25


@pytest.mark.parametrize('together', [True, False])
def test_an_arm_that_has_lost_a_joint_stops_as_one_or_goes_on_as_told(together: bool) -> None:
    with arm(io__together=together) as made:
        made.commanded(1.0)
        others = {'waist': 0.0, 'elbow': 0.0}
        assert made.hear(others) == ['waist', 'elbow']  # missing is not silent yet
        made.lose('gripper')
        for lost in (others, {**others, 'gripper': nan}):
            assert made.hear(lost) == ([] if together else ['waist', 'elbow'])
        assert (made.hear(AT_ZERO), made.hear(AT_ZERO)) == (list(JOINTS), list(JOINTS))


def test_references_are_held_and_those_that_say_nothing_are_passed_over() -> None:
    with arm() as made:
        made.commanded(0.5)
        before = made.sent[-1]['gripper']
        made.node._on_reference({'gripper': nan, 'elbow': 0.25})
        for _ in range(10):
            made.hear(AT_ZERO)
        assert made.sent[-1]['gripper'] == before == pytest.approx(0.5, abs=1e-12)
        assert made.sent[-1]['elbow'] != made.sent[-1]['waist']


def test_joints_begin_where_they_stand() -> None:
    with arm(control__rate_max=1.0) as made:
        made.node._on_reference(dict.fromkeys(JOINTS, 1.0))
        made.hear({'waist': 0.5, 'elbow': -0.25, 'gripper': 0.125})
        one_step = 1.0 * 0.02 * (1.0 + 1e-9)
        assert made.sent[0] == pytest.approx(
            {'waist': 0.5, 'elbow': -0.25, 'gripper': 0.125}, abs=one_step)


def test_joints_that_have_news_at_once_tell_them_one_per_sample() -> None:
    with arm() as made:
        told: list[str] = []
        for joint in made.node.joints:
            joint.diagnose = lambda *known, name=joint.name: told.append(name)
        made.node._on_reference(dict.fromkeys(JOINTS, 1.0))
        for count in (1, 2, 3, 3):
            made.hear(AT_ZERO)
            assert len(told) == count
        assert told == list(JOINTS)
