"""What can be asked of a running controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future as Writing
from typing import cast

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from backlash_ros.core.estimates_file import worth_saving
from backlash_ros.core.loop.control_loop import ControlLoop

UNCONFIGURED = 'the controller is unconfigured: configure it first'


def offer_services(
    node: Node, loops_of: Callable[[], Sequence[ControlLoop]],
    save_estimates: Callable[[], list[Writing[str]]], files: Callable[[], str],
) -> None:
    """Create ~/freeze_adaptation, ~/enable_compensation, ~/reset_estimates, ~/save_estimates.

    loops_of: the loops, none while there are none. save_estimates: begins to save what is worth
    it; each result says why it failed, empty if it did not. files: where to, empty for nowhere.
    """

    def when_configured(
        response: SetBool.Response | Trigger.Response, action: Callable[[ControlLoop], None],
        done: str,
    ) -> None:
        loops = loops_of()
        for loop in loops:
            action(loop)
        response.success = bool(loops)
        response.message = done if loops else UNCONFIGURED
        node.get_logger().info(response.message)

    def freeze(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        when_configured(
            response, lambda loop: loop.adapt(not request.data),
            'estimates are held' if request.data else 'the controller learns',
        )
        return response

    def enable(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        when_configured(
            response, lambda loop: loop.compensate(request.data),
            'the gap is compensated' if request.data else 'the gap is not compensated',
        )
        return response

    def reset(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        when_configured(
            response, lambda loop: loop.reset(),
            'the estimates are those of estimator.initial',
        )
        return response

    async def save(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not loops_of():
            response.message = UNCONFIGURED
        elif not files():
            response.message = 'estimates.file is empty, so there is nowhere to save: start with ' \
                '-p estimates.file:=PATH, or set it while unconfigured'
        elif not any(worth_saving(loop.estimate) for loop in loops_of()):
            response.message = 'nothing was learned yet'
        else:
            # The loop goes on while the disk takes its time.
            reasons = []
            for saved in save_estimates():
                reasons.append(await _result_of(saved))
            why = '; '.join(filter(None, reasons))
            response.success = not why
            response.message = why or f'saved in {files()}'
        return response

    node.create_service(SetBool, '~/freeze_adaptation', freeze)
    node.create_service(SetBool, '~/enable_compensation', enable)
    node.create_service(Trigger, '~/reset_estimates', reset)
    # In a group of its own, so that it does not keep the others waiting.
    node.create_service(
        Trigger, '~/save_estimates', cast(Callable[..., Trigger.Response], save),
        callback_group=MutuallyExclusiveCallbackGroup(),
    )


async def _result_of(writing: Writing[str]) -> str:
    """What a thread comes to, while the executor goes on."""
    written: Future = Future()
    writing.add_done_callback(lambda _: written.set_result(None))
    await written
    return writing.result()
