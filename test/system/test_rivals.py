"""Several publishers of the command: who is told, who stands down, and how it goes on."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from drivers.paced_driver import NOISE, PacedDriver
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from ros_processes import NodeProcess, RosWorld, ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.nodes.diagnostics.rivals import ENDPOINT, SINCE, Rival, Rivals
from backlash_ros.nodes.runtime.messages import SILENT_S

PROMPTLY_S = 1.0  # within which both have to name the other
RATE_MAX, PERIOD_S = 400.0, 0.01
STEP = RATE_MAX * PERIOD_S * (1.0 + 1e-9)


class Stage:
    """One driver, controllers that want to command it, and what they say."""

    def __init__(self, world: RosWorld) -> None:
        self.world = world
        self.driver = PacedDriver(world.probe())
        self._diagnostics = self.driver.probe.collect(topics.DIAGNOSTICS, DiagnosticArray)

    def start(self, name: str, **parameters: object) -> NodeProcess:
        """A controller with a name of its own."""
        values = {
            'estimator.output_noise_std': NOISE, 'control.rate_max': RATE_MAX, **parameters,
        }
        # The topics of both keep the names under which the driver listens.
        same = [
            part for topic in (topics.ESTIMATES, topics.SIGNALS)
            for part in ('-r', f'{topics.of_node(topic)}:={topic}')
        ]
        return self.world.start('controller', values, '-r', f'__node:={name}', *same)

    def status(self, name: str) -> DiagnosticStatus | None:
        """The newest that a controller has said."""
        found = [each for message in self._diagnostics for each in message.status]
        return next((each for each in reversed(found) if each.name == name), None)

    def names_as_error(self, name: str, rival: str) -> bool:
        """Whether a controller says at level ERROR who else there is."""
        status = self.status(name)
        return (
            status is not None and status.level == DiagnosticStatus.ERROR
            and rival in status.message
        )

    def run_until(self, condition: Callable[[], object], what: str) -> None:
        """Let the loop go on."""
        self.driver.run_until(condition, what)

    def samples(self, name: str) -> int:
        """Commands that a controller has sent."""
        status = self.status(name)
        values = {each.key: each.value for each in status.values} if status else {}
        return int(values.get('samples', 0))

    def commands_seen_by_all(self) -> list[float]:
        """Every v, whoever sent it."""
        return [message.data for message in self.driver.controls]


def stage_with_first(world: RosWorld, **parameters: object) -> tuple[Stage, NodeProcess]:
    """A driver that a controller commands."""
    stage = Stage(world)
    first = stage.start('first', **parameters)
    stage.driver.meet(first)
    stage.run_until(lambda: len(stage.driver.controls) > 20, 'controls')
    return stage, first


def test_the_later_controller_stands_down_and_both_name_the_other(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        second = stage.start('second', **{'proportional.f': 0.0})
        stage.run_until(lambda: second.events('ready'), 'the second')
        begin = time.monotonic()
        stage.run_until(
            lambda: stage.names_as_error('first', '/second')
            and stage.names_as_error('second', '/first'), 'both to name the other',
        )
        assert time.monotonic() - begin < PROMPTLY_S
        stage.driver.run(1.0)
        status = stage.status('second')
        assert status is not None
        assert 'standing down' in status.message
        assert stage.samples('second') == 0
        assert stage.samples('first') > 0
        # It goes on at once where the first one left v, as fast as it may.
        assert first.stop() == 0
        stage.run_until(lambda: stage.samples('second') > 50, 'commands of the second')
        commands = stage.commands_seen_by_all()
        assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
        status = stage.status('second')
        assert status is not None
        assert '/first' not in status.message
        assert second.stop() == 0
        assert 'standing down' in second.stderr
        assert 'nobody else publishes /control any more' in second.stderr


def test_whoever_was_first_is_waited_for_however_late_it_is_discovered(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        # A process that is stopped answers to nobody's discovery.
        first.send(signal.SIGSTOP)
        second = stage.start('second')
        stage.run_until(lambda: stage.status('second'), 'the second')
        commands = len(stage.commands_seen_by_all())
        stage.driver.run(2.0)
        assert len(stage.commands_seen_by_all()) == commands
        first.send(signal.SIGCONT)
        stage.run_until(lambda: stage.names_as_error('second', '/first'), 'the second to tell')
        stage.driver.run(0.5)
        assert stage.samples('second') == 0
        assert [each.stop() for each in (first, second)] == [0, 0]


def test_nobody_is_waited_for_who_is_gone(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        first.send(signal.SIGSTOP)
        second = stage.start('second')
        stage.run_until(
            lambda: 'waiting for discovery of another controller of /control' in second.stderr,
            'a word about it',
        )
        first.kill()
        stage.run_until(lambda: stage.samples('second') > 20, 'commands of the second')
        assert second.stop() == 0


def test_a_controller_that_stands_down_sends_no_last_command(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        second = stage.start('second', on_stop='zero')
        stage.run_until(lambda: stage.names_as_error('second', '/first'), 'the second to tell')
        assert second.stop() == 0
        stage.driver.run(0.1)
        commands = stage.commands_seen_by_all()
        assert 0.0 not in commands[20:]
        assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
        stage.run_until(lambda: not stage.names_as_error('first', '/second'), 'the first alone')
        assert first.stop() == 0


def test_with_on_rival_warn_both_go_on_and_say_so(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world, on_rival='warn')
        second = stage.start('second', on_rival='warn')
        stage.run_until(
            lambda: stage.names_as_error('first', '/second')
            and stage.names_as_error('second', '/first'), 'both to name the other',
        )
        stage.run_until(lambda: stage.samples('second') > 20, 'commands of the second')
        assert first.stop() == 0
        assert second.stop() == 0


def test_on_rival_may_change_while_a_controller_stands_down(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        second = stage.start('second')
        stage.run_until(lambda: stage.names_as_error('second', '/first'), 'the second to tell')
        assert stage.samples('second') == 0
        client = stage.driver.probe.node.create_client(SetParameters, 'second/set_parameters')
        stage.run_until(client.service_is_ready, 'the service')
        request = SetParameters.Request(
            parameters=[Parameter('on_rival', value='warn').to_parameter_msg()]
        )
        answer = client.call_async(request)
        stage.run_until(answer.done, 'an answer')
        stage.run_until(lambda: stage.samples('second') > 20, 'commands of the second')
        assert [each.stop() for each in (first, second)] == [0, 0]


def test_of_two_that_start_together_one_commands(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        both = [stage.start(name) for name in ('left', 'right')]
        for controller in both:
            stage.driver.meet(controller)
        stage.run_until(
            lambda: stage.names_as_error('left', '/right')
            and stage.names_as_error('right', '/left'), 'both to name the other',
        )
        stage.run_until(
            lambda: stage.samples('left') + stage.samples('right') > 100, 'commands'
        )
        assert min(stage.samples('left'), stage.samples('right')) == 0
        assert [controller.stop() for controller in both] == [0, 0]


def test_whoever_finds_another_program_at_the_command_stands_down(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        other = world.probe()
        publisher = other.publisher(topics.CONTROL, Float64)
        controller = stage.start('second')
        stage.driver.meet(controller)
        stage.run_until(lambda: stage.names_as_error('second', '/probe'), 'a word about it')
        for _ in range(20):
            publisher.publish(Float64(data=3.0))
            stage.driver.run(0.02)
        assert stage.samples('second') == 0
        other.node.destroy_publisher(publisher)
        stage.run_until(lambda: stage.samples('second') > 20, 'commands')
        commands = stage.commands_seen_by_all()
        # The first own command goes on from what the other one sent last.
        assert commands.count(3.0) >= 15
        assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
        assert controller.stop() == 0


def test_whoever_was_first_tells_of_another_program_and_goes_on(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        other = world.probe()
        other.publisher(topics.CONTROL, Float64)
        begin = time.monotonic()
        stage.run_until(lambda: stage.names_as_error('first', '/probe'), 'a word about it')
        assert time.monotonic() - begin < PROMPTLY_S
        samples = stage.samples('first')
        stage.run_until(lambda: stage.samples('first') > samples + 100, 'commands')
        assert first.stop() == 0
        assert 'standing down' not in first.stderr


def test_an_inactive_controller_is_no_rival(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        idle = stage.start('idle', autostart=False)
        stage.run_until(lambda: stage.status('idle'), 'the idle one')
        first = stage.start('first')
        stage.driver.meet(first)
        stage.run_until(lambda: stage.samples('first') > 100, 'commands')
        assert not stage.names_as_error('first', '/idle')
        client = stage.driver.probe.node.create_client(ChangeState, 'idle/change_state')
        for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
            stage.run_until(client.service_is_ready, 'the service')
            answer = client.call_async(
                ChangeState.Request(transition=Transition(id=transition))
            )
            stage.run_until(answer.done, 'an answer')
            assert answer.result().success
        stage.run_until(
            lambda: stage.names_as_error('first', '/idle')
            and stage.names_as_error('idle', '/first'), 'both to name the other',
        )
        assert stage.samples('idle') == 0
        assert [each.stop() for each in (idle, first)] == [0, 0]


def test_a_killed_controller_gives_way_to_the_one_that_stood_down(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        second = stage.start('second')
        stage.run_until(lambda: stage.names_as_error('second', '/first'), 'the second to tell')
        stage.driver.run(1.0)
        first.kill()
        begin = time.monotonic()
        stage.run_until(lambda: stage.samples('second') > 20, 'commands of the second')
        # Long before the middleware gives the killed one up, which takes 20 s.
        assert time.monotonic() - begin < SILENT_S + 4.0
        assert second.stop() == 0


def test_a_long_ramp_at_the_end_is_not_cut_off_by_whoever_stands_down(tmp_path: Path) -> None:
    slow = {'control.rate_max': 2.0, 'control.initial': 12.0, 'on_stop': 'ramp',
            'timeout.ramp': 20.0}
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world, **slow)
        second = stage.start('second', **slow)
        stage.run_until(lambda: stage.names_as_error('second', '/first'), 'the second to tell')
        stage.driver.run(1.0)
        v_at_end = stage.driver.controls[-1].data
        assert v_at_end > 2.0 * (SILENT_S + 1.0)
        begin = len(stage.driver.controls) + 50  # the signal is heard by then
        first.send(signal.SIGINT)
        stage.run_until(lambda: stage.driver.controls[-1].data == 0.0, 'the end of the ramp')
        ramp = stage.commands_seen_by_all()[begin:]
        assert len(ramp) > SILENT_S / PERIOD_S
        steps = [b - a for a, b in pairwise(ramp)]
        assert steps[:-1] == pytest.approx([-2.0 * PERIOD_S] * (len(steps) - 1))
        assert first.wait() == 0
        second.kill()


def test_a_rival_is_found_at_the_command_of_ros2_control(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        other = world.probe()
        publisher = other.publisher(topics.JOINT_COMMANDS, Float64MultiArray)
        controller = stage.start('second', **{'io.style': 'ros2_control', 'io.joint': 'axle'})
        stage.run_until(lambda: stage.names_as_error('second', '/probe'), 'a word about it')
        status = stage.status('second')
        assert status is not None
        assert 'forward_command_controller/commands' in status.message
        other.node.destroy_publisher(publisher)
        stage.run_until(lambda: not stage.names_as_error('second', '/probe'), 'being alone')
        assert controller.stop() == 0


def test_two_references_are_named(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        stage, first = stage_with_first(world)
        other = world.probe()
        other.publisher(topics.REFERENCE, Float64)
        # A busy machine may bring errors that pass.
        stage.run_until(
            lambda: (status := stage.status('first')) is not None
            and 'reference is published by /probe' in status.message
            and status.level == DiagnosticStatus.WARN, 'a word about it',
        )
        assert first.stop() == 0


def rivals_of(own: str = 'b', active_at: float = 10.0, since_ns: int = 100) -> Rivals:
    rivals = Rivals(own, settled_at=5.0)
    rivals.begin(since_ns, active_at)
    return rivals


def claim(identity: str, since_ns: int) -> dict[str, Any]:
    return {ENDPOINT: identity, SINCE: str(since_ns)}


@pytest.mark.parametrize(
    ('identity', 'since_ns', 'was_first'),
    [('x', 99, True), ('x', 101, False), ('a', 100, True), ('c', 100, False)],
)
def test_the_time_of_activation_decides_and_the_identity_where_it_is_equal(
    identity: str, since_ns: int, was_first: bool,
) -> None:
    rivals = rivals_of()
    rivals.hear(claim(identity, since_ns), 10.0)
    rivals.among({identity: '/other'}, 10.0)
    rivals.hear(claim(identity, since_ns), 10.5)
    assert rivals.among({identity: '/other'}, 11.0) == (Rival('/other', was_first),)


def test_without_a_word_presence_at_activation_decides() -> None:
    rivals = rivals_of(active_at=10.0)
    rivals.among({'x': '/early'}, 9.0)
    found = rivals.among({'x': '/early', 'y': '/late'}, 11.0)
    assert found == (Rival('/early', True), Rival('/late', False))


def test_a_node_that_has_just_started_takes_whom_it_finds_for_earlier() -> None:
    rivals = Rivals('b', settled_at=10.7)
    rivals.begin(100, now=10.0)
    assert rivals.among({'x': '/other'}, 10.5) == (Rival('/other', True),)


def test_a_controller_that_says_nothing_any_more_is_gone_though_discovery_still_has_it() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 50), 10.0)
    assert rivals.among({'x': '/other'}, 10.0 + 0.9 * SILENT_S) == (Rival('/other', True),)
    assert rivals.among({'x': '/other'}, 10.0 + 1.1 * SILENT_S) == ()


def test_who_is_inactive_has_no_rivals_and_is_none() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 0), 10.0)
    assert rivals.among({'x': '/other'}, 10.1) == ()
    rivals.hear(claim('x', 50), 10.2)
    assert rivals.among({'x': '/other'}, 10.3) == (Rival('/other', True),)
    rivals.end()
    assert rivals.among({'x': '/other'}, 10.4) == ()
