"""What can be asked of a running controller."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future as Writing
from typing import Protocol, cast

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from backlash_ros.core.estimates_file import worth_saving
from backlash_ros.core.loop.control_loop import ControlLoop

UNCONFIGURED = 'the controller is unconfigured: configure it first'


class Served(Protocol):
    """What the services are about."""

    loop: ControlLoop | None

    def save_estimates(self) -> Writing[str]:
        """Begin to save the estimates; the result says why it failed, empty if it did not."""

    @property
    def estimates_file(self) -> str:
        """Where to, empty for nowhere."""


def offer_services(node: Node, served: Served) -> None:
    """Create ~/freeze_adaptation, ~/enable_compensation, ~/reset_estimates, ~/save_estimates."""

    def when_configured(
        response: SetBool.Response | Trigger.Response, action: Callable[[ControlLoop], str],
    ) -> None:
        loop = served.loop
        response.success = loop is not None
        response.message = UNCONFIGURED if loop is None else action(loop)
        node.get_logger().info(response.message)

    def freeze(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def set_adapting(loop: ControlLoop) -> str:
            loop.adapt(not request.data)
            return 'estimates are held' if request.data else 'the controller learns'

        when_configured(response, set_adapting)
        return response

    def enable(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        def set_compensating(loop: ControlLoop) -> str:
            loop.compensate(request.data)
            return 'the gap is compensated' if request.data else 'the gap is not compensated'

        when_configured(response, set_compensating)
        return response

    def reset(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        def begin_anew(loop: ControlLoop) -> str:
            loop.reset()
            return 'the estimates are those of estimator.initial'

        when_configured(response, begin_anew)
        return response

    async def save(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        loop = served.loop
        if loop is None:
            response.message = UNCONFIGURED
        elif not served.estimates_file:
            response.message = 'estimates.file is empty, so there is nowhere to save: start with ' \
                '-p estimates.file:=PATH, or set it while unconfigured'
        elif not worth_saving(loop.estimate):
            response.message = 'nothing was learned yet'
        else:
            # The loop goes on while the disk takes its time.
            written: Future = Future()
            saved = served.save_estimates()
            saved.add_done_callback(lambda _: written.set_result(None))
            await written
            why = saved.result()
            response.success = not why
            response.message = why or f'saved in {served.estimates_file}'
        return response

    node.create_service(SetBool, '~/freeze_adaptation', freeze)
    node.create_service(SetBool, '~/enable_compensation', enable)
    node.create_service(Trigger, '~/reset_estimates', reset)
    # In a group of its own, so that it does not keep the others waiting.
    node.create_service(
        Trigger, '~/save_estimates', cast(Callable[..., Trigger.Response], save),
        callback_group=MutuallyExclusiveCallbackGroup(),
    )

