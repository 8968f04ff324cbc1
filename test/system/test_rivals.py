"""Several publishers of the command; a controller whose fits are made by a worker, and deaths."""

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import psutil
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from drivers.paced_driver import OF_THE_LOOP, PERIOD_S, PacedDriver, controller_and_driver
from ros_processes import NodeProcess, RosWorld, ros_world
from std_msgs.msg import Float64
from waiting import wait_until

from backlash_ros import topics
from backlash_ros.core import jobs

RATE_MAX = 150.0
STEP = RATE_MAX * PERIOD_S * (1.0 + 1e-9)


class Stage:
    """One driver, controllers that want to command it, and what they say."""

    def __init__(self, world: RosWorld) -> None:
        self.world = world
        self.driver = PacedDriver(world.probe())
        self._diagnostics = self.driver.probe.collect(topics.DIAGNOSTICS, DiagnosticArray)

    def start(self, name: str) -> NodeProcess:
        # The topics of both keep the names under which the driver listens.
        same = [
            part for topic in (topics.ESTIMATES, topics.SIGNALS)
            for part in ('-r', f'{topics.of_node(topic)}:={topic}')]
        values = {'control.rate_max': RATE_MAX, **OF_THE_LOOP}
        return self.world.start('controller', values, '-r', f'__node:={name}', *same)

    def status(self, name: str) -> DiagnosticStatus | None:
        found = [each for message in self._diagnostics for each in message.status]
        return next((each for each in reversed(found) if each.name == name), None)

    def names_as_error(self, name: str, rival: str) -> bool:
        status = self.status(name)
        return (
            status is not None and status.level == DiagnosticStatus.ERROR
            and rival in status.message)

    def run_until(self, condition: Callable[[], object], what: str) -> None:
        self.driver.run_until(condition, what)

    def samples(self, name: str) -> int:
        status = self.status(name)
        values = {each.key: each.value for each in status.values} if status else {}
        return int(values.get('samples', 0))

    def commands(self) -> list[float]:
        return [message.data for message in self.driver.controls]


def test_the_later_controller_stands_down_until_the_first_one_has_gone_or_is_dead(tmp_path):
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        first = stage.start('first')
        stage.driver.meet(first)
        stage.run_until(lambda: len(stage.driver.controls) > 20, 'controls')
        second = stage.start('second')
        stage.run_until(
            lambda: stage.names_as_error('first', '/second')
            and stage.names_as_error('second', '/first'), 'both to name the other')
        stage.driver.run(50)
        status = stage.status('second')
        assert 'standing down' in status.message
        assert stage.samples('second') == 0
        # It goes on where the first one left v, as fast as it may.
        assert first.stop() == 0
        stage.run_until(lambda: stage.samples('second') > 50, 'commands of the second')
        commands = stage.commands()
        assert max(abs(b - a) for a, b in pairwise(commands)) <= STEP
        assert not stage.names_as_error('second', '/first')
        # A process that is stopped answers to nobody's discovery.
        second.send(signal.SIGSTOP)
        third = stage.start('third')
        stage.run_until(
            lambda: stage.names_as_error('third', 'standing down: another node'), 'a word about it')
        assert stage.samples('third') == 0
        second.send(signal.SIGCONT)
        stage.run_until(lambda: stage.names_as_error('third', '/second'), 'the third to tell')
        stage.driver.run(50)
        assert stage.samples('third') == 0
        second.kill()
        stage.run_until(lambda: stage.samples('third') > 20, 'commands of the third')
        assert third.stop() == 0
    assert 'nobody else publishes /control any more' in second.stderr


def test_another_program_is_given_way_to_where_it_was_first_and_named_where_not(tmp_path):
    with ros_world(tmp_path) as world:
        stage = Stage(world)
        other = world.probe()
        publisher = other.publisher(topics.CONTROL, Float64)
        controller = stage.start('second')
        stage.driver.meet(controller)
        stage.run_until(lambda: stage.names_as_error('second', '/probe'), 'a word about it')
        for _ in range(20):
            publisher.publish(Float64(data=3.0))
            stage.driver.run(1)
        assert stage.samples('second') == 0
        other.node.destroy_publisher(publisher)
        stage.run_until(lambda: stage.samples('second') > 20, 'commands')
        # The first own command goes on from what the other one sent last.
        assert stage.commands().count(3.0) >= 15
        assert max(abs(b - a) for a, b in pairwise(stage.commands())) <= STEP
        other.publisher(topics.CONTROL, Float64)
        other.publisher(topics.REFERENCE, Float64)
        stage.run_until(lambda: stage.names_as_error('second', '/probe'), 'a word about it')
        samples = stage.samples('second')
        stage.run_until(lambda: stage.samples('second') > samples + 50, 'commands')
        stage.run_until(
            lambda: any('reference is published by /probe' in pair.value
                        for pair in stage.status('second').values), 'a word about the reference')
        assert controller.stop() == 0


KILLED = 3  # times
UNCERTAIN: dict[str, object] = {'plant.uncertainty': 0.2}


def workers_of(controller: NodeProcess) -> list[int]:
    found = []
    for child in psutil.Process(controller.process.pid).children():
        with suppress(psutil.Error):  # it has ended meanwhile
            if jobs.__name__ in ' '.join(child.cmdline()):
                found.append(child.pid)
    return found


def test_a_worker_that_is_killed_costs_no_estimate_and_ends_with_its_controller(tmp_path):
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, reports_applied=True, **UNCERTAIN)
        driver.learn()
        learned = len(driver.estimates)
        for count in range(1, KILLED + 1):
            driver.run_until(lambda: workers_of(controller), 'a worker')
            (pid,) = workers_of(controller)
            os.kill(pid, signal.SIGKILL)
            driver.run_until(
                lambda: driver.value('processes for fits that died') == count,  # noqa: B023
                'its death is told',
            )
        assert driver.says('the process that makes the fits died')
        driver.run_until(lambda: workers_of(controller), 'another worker')
        (pid,) = workers_of(controller)
        held = np.array([message.data[:3] for message in driver.estimates[learned:]])
        assert np.abs(held / [1.3, 3.0, -3.0] - 1.0).max() < 0.02
        driver.check_sanity()
        assert controller.stop() == 0
        wait_until(lambda: not Path(f'/proc/{pid}').exists(), 'the end of the worker')
        assert 'Traceback' not in controller.stderr
