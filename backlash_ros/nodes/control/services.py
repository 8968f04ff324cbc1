"""What can be asked of a running controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future as Writing
from typing import Any, cast

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from backlash_ros.core.estimates_file import worth_saving
from backlash_ros.core.loop.control_loop import ControlLoop


def offer_services(
    node: Node, loops_of: Callable[[], Sequence[ControlLoop]],
    save_estimates: Callable[[], list[Writing[str]]], files: Callable[[], str],
) -> None:
    """Create ~/freeze_adaptation, ~/enable_compensation, ~/reset_estimates, ~/save_estimates.

    loops_of: the loops, none while there are none. save_estimates: begins to save what is worth
    it; each result says why it failed, empty if it did not. files: where to, empty for nowhere.
    """
    unconfigured = 'the controller is unconfigured: configure it first'

    def offer(
        kind: type[SetBool] | type[Trigger], name: str,
        act: Callable[[ControlLoop, bool], None], done: tuple[str, str],
    ) -> None:
        """Act upon all loops; the bool, and which text it is done with, is what was asked for."""
        def serve(request: Any, response: Any) -> Any:
            loops, wanted = loops_of(), getattr(request, 'data', True)
            for loop in loops:
                act(loop, wanted)
            response.success = bool(loops)
            response.message = done[wanted] if loops else unconfigured
            node.get_logger().info(response.message)
            return response

        node.create_service(kind, name, serve)

    async def save(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not loops_of():
            response.message = unconfigured
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

    offer(SetBool, '~/freeze_adaptation', lambda loop, frozen: loop.adapt(not frozen),
          ('the controller learns', 'estimates are held'))
    offer(SetBool, '~/enable_compensation', lambda loop, on: loop.compensate(on),
          ('the gap is not compensated', 'the gap is compensated'))
    offer(Trigger, '~/reset_estimates', lambda loop, _: loop.reset(),
          ('', 'the estimates are those of estimator.initial'))
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
