"""What a driver or a sensor may do to the controller, with real processes in real time."""

from __future__ import annotations

from itertools import pairwise
from math import inf, isfinite, nan
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from drivers.paced_driver import controller_and_driver
from ros_processes import ros_world
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.estimate import Status

ABSURD = (nan, inf, -inf, 1e300, -1e300)


def test_absurd_numbers_are_dropped_counted_and_change_nothing(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(
            world, reports_applied=True, **{'estimator.use_applied_control': True}
        )
        assert driver.applied is not None
        driver.learn()
        before = driver.value('non-finite dropped')
        for bad in ABSURD:
            driver.output.publish(Float64(data=bad))
            driver.reference.publish(Float64(data=bad))
            driver.applied.publish(Float64(data=bad))
            driver.rest()
            commands = len(driver.controls)
            driver.run_until(
                lambda commands=commands: len(driver.controls) > commands + 5, 'further commands'
            )
        # An output between two samples may be taken for a repetition before anybody looks into it.
        driver.run_until(
            lambda: driver.value('non-finite dropped') >= before + 2 * len(ABSURD), 'the count'
        )
        driver.run_until_known(0.02)
        assert all(isfinite(message.data) for message in driver.controls)
        driver.check_sanity()
        assert controller.stop() == 0


def test_denormal_numbers_are_numbers_like_others(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.sent = lambda k, y: [5e-324 if k < 20 else y]
        driver.learn()
        assert driver.value('non-finite dropped') == 0
        driver.check_sanity()
        assert controller.stop() == 0


@pytest.mark.parametrize('action', ['hold', 'zero', 'ramp'])
def test_silent_driver_brings_the_configured_command_and_a_return_without_a_jump(
    tmp_path: Path, action: str,
) -> None:
    rate_max = 400.0
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{
            'on_timeout': action, 'timeout.plant_output': 0.2, 'control.rate_max': rate_max,
        })
        driver.learn()
        driver.run_until(lambda: abs(driver.v) > 5.0, 'a v away from 0')
        sound, driver.sent = driver.sent, lambda k, y: []
        driver.run_until(lambda: driver.says('no plant_output'), 'a word about the silence')
        status = driver.status()
        assert status is not None
        assert status.level == DiagnosticStatus.WARN
        if action == 'hold':
            answers = len(driver.controls)
            driver.run(0.3)
            assert len(driver.controls) == answers
        else:
            driver.run_until(lambda: driver.controls[-1].data == 0.0, 'v at 0')
        silent_from = len(driver.controls)
        driver.sent = sound
        driver.run_until(lambda: len(driver.controls) > silent_from + 50, 'the return')
        driver.run_until_known(0.05)
        commands = [message.data for message in driver.controls]
        steps = [abs(b - a) for a, b in pairwise(commands)]
        # 0.01 s at rate_max; zero is at once.
        allowed = steps[silent_from - 1:] if action == 'zero' else steps
        assert max(allowed) <= rate_max * 0.01 * (1.0 + 1e-9)
        driver.check_sanity()
        assert controller.stop() == 0


def test_missing_reference_is_held_and_told(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, **{'timeout.reference': 0.3})
        driver.learn()
        driver.referred = False
        driver.run_until(lambda: driver.says('no reference'), 'a word about the reference')
        assert driver.signals[-1].data[0] == driver.signals[-10].data[0]
        driver.referred = True
        driver.run_until(lambda: not driver.says('no reference'), 'the end of the warning')
        assert controller.stop() == 0


@pytest.mark.parametrize('share', [0.01, 0.1, 0.3])
def test_lost_outputs_leave_the_estimates_within_5_percent(tmp_path: Path, share: float) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        # They are never published, so the numbers have no gap: arrival times have to do.
        driver.sent = lambda k, y: [] if driver.rng.random() < share else [y]
        driver.run(1.0)
        driver.run_until_known(0.05)
        driver.run_until(lambda: driver.value('lost') > 0, 'the count of the lost ones')
        assert driver.value('of these never sent') > 0
        driver.check_sanity()
        assert controller.stop() == 0


def lost_in_bursts(k: int, y: float) -> list[float]:
    return [] if k % 150 >= 100 else [y]


def doubled(k: int, y: float) -> list[float]:
    return [y, y]


class Swapped:
    """Every tenth output comes after the one that follows it."""

    def __init__(self) -> None:
        self._kept: list[float] = []

    def __call__(self, k: int, y: float) -> list[float]:
        if k % 10 == 9:
            self._kept = [y]
            return []
        kept, self._kept = self._kept, []
        return [y, *kept]


@pytest.mark.parametrize('fault', [lost_in_bursts, doubled, Swapped()])
def test_bursts_repetitions_and_wrong_order_leave_the_estimates_within_5_percent(
    tmp_path: Path, fault: object,
) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        driver.sent = fault  # type: ignore[assignment]
        driver.run(1.6)  # longer than from burst to burst
        driver.run_until_known(0.05)
        driver.check_sanity()
        assert controller.stop() == 0


@pytest.mark.parametrize(('share', 'parameters'), [
    (0.01, {}), (0.1, {'estimator.use_applied_control': True}), (0.3, {}),
    (0.3, {'estimator.use_applied_control': True}),
])
def test_lost_controls_that_the_driver_reports_leave_the_estimates_within_5_percent(
    tmp_path: Path, share: float, parameters: dict[str, object],
) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, reports_applied=True, **parameters)
        driver.heard = lambda: bool(driver.rng.random() > share)
        driver.run(1.0)
        driver.run_until_known(0.05)
        driver.check_sanity()
        assert controller.stop() == 0


def test_reports_that_stop_are_given_up_and_the_loop_goes_on_learning(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world, reports_applied=True)
        driver.run_until(lambda: driver.text('using applied_control') == 'True', 'their use')
        driver.learn()
        driver.applied = None
        driver.run_until(lambda: driver.text('using applied_control') == 'False', 'their end')
        missed = driver.value('without applied_control')
        driver.learn()
        assert driver.value('without applied_control') == missed
        assert controller.stop() == 0


def test_lost_controls_that_nobody_reports_are_said_to_be_inconsistent(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        driver.heard = lambda: bool(driver.rng.random() > 0.3)
        driver.run_until(lambda: driver.says('does not follow from v'), 'the contradiction')
        driver.run(1.0)
        driver.run_until_known(0.2)
        driver.check_sanity()
        assert controller.stop() == 0


def test_second_publisher_is_told_and_the_first_one_kept(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        second = world.probe().publisher(topics.PLANT_OUTPUT, Float64)
        sound = driver.sent

        def with_stranger(k: int, y: float) -> list[float]:
            second.publish(Float64(data=-y + 3.0))
            return sound(k, y)

        driver.sent = with_stranger
        driver.run_until(lambda: driver.says('2 publishers'), 'a word about the second one')
        driver.run(0.5)
        driver.run_until_known(0.02)
        driver.run_until(
            lambda: driver.value('repeated or from a second driver') > 50, 'the count of refused'
        )
        used = {message.data[1] for message in driver.signals[-50:]}
        assert used <= set(driver.y)
        driver.check_sanity()
        assert controller.stop() == 0


@pytest.mark.parametrize('broken', ['sign', 'constant'])
def test_broken_sensor_holds_the_last_good_estimates_and_is_an_error(
    tmp_path: Path, broken: str,
) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        stuck, late = driver.y[-1], driver.value('late')
        driver.sent = lambda k, y: [-y if broken == 'sign' else stuck]
        driver.run_until(lambda: driver.says('does not follow from v'), 'the contradiction')
        # On a busy machine it may be put down to late samples at first.
        driver.run_until(
            lambda: (status := driver.status()) and status.level == DiagnosticStatus.ERROR,
            'the error',
        )
        assert driver.signals[-1].data[6] == Status.INCONSISTENT
        held = driver.estimate()
        driver.run(0.5)
        assert driver.estimate() == held
        # Where a busy machine makes commands late, the contradiction shows later.
        assert driver.error() < (0.05 if driver.value('late') == late else 0.1)
        driver.check_sanity()
        assert controller.stop() == 0


def test_flood_is_survived_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.learn()
        driver.sent = lambda k, y: [y] * 20
        driver.run(0.5)
        driver.sent = lambda k, y: [y]

        def is_up_to_date() -> bool:
            return driver.signals[-1].data[1] in driver.y[-5:]

        driver.run_until(is_up_to_date, 'an answer to a new output')
        outputs, commands = len(driver.y), len(driver.controls)
        driver.run(0.5)
        # An answer per output again, none of them to an old one.
        assert len(driver.controls) - commands <= len(driver.y) - outputs + 5
        driver.run_until(is_up_to_date, 'an answer to a new output once more')
        driver.run_until_known(0.05)
        driver.check_sanity()
        assert controller.stop() == 0
