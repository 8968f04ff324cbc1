"""What a signal leaves behind: v, estimates, a process that ends soon."""

from __future__ import annotations

import signal
from pathlib import Path

from drivers.paced_driver import controller_and_driver
from ros_processes import ros_world


def test_a_ramp_longer_than_it_may_last_stops_where_it_is(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, **{'on_stop': 'ramp', 'control.rate_max': 20.0, 'timeout.ramp': 0.1}
        )
        driver.run_until(lambda: abs(driver.v) > 3.0, 'a v away from 0')
        controller.send(signal.SIGINT)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert abs(driver.controls[-1].data) > 0.1
        assert 'is held: it did not reach zero within timeout.ramp=0.1 s' in controller.stderr


def test_what_was_learned_is_saved_at_the_end(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, **{'estimates.file': str(file), 'estimates.save_period': 0.0}
        )
        driver.learn()
        assert not file.exists()
        controller.send(signal.SIGTERM)
        driver.run_until(lambda: controller.process.poll() is not None, 'the end')
        assert controller.process.returncode == 0
        assert file.exists()
