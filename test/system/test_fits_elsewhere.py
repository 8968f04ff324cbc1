"""A controller whose fits are made by a worker: what the death of either costs the other."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
from drivers.paced_driver import controller_and_driver
from ros_processes import NodeProcess, ros_world
from waiting import wait_until

from backlash_ros.core import jobs

KILLED = 3  # times
UNCERTAIN: dict[str, object] = {'plant.uncertainty': 0.2}


def workers_of(controller: NodeProcess) -> list[int]:
    """Process ids of the workers that a controller has started and that still run."""
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
