"""What can be asked of a running controller: transitions of its life cycle, and its services."""

from collections.abc import Callable, Sequence
from typing import Any, cast

from lifecycle_msgs.srv import ChangeState
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.nodes.control.joint import Joint
from backlash_ros.nodes.runtime.process import ProcessNode


def refuse_unfit_transitions(node: Node) -> None:
    """Answer a transition that the present state does not have, instead of ending of it."""
    service = next(s for s in node.services if s.srv_type is ChangeState)
    change = cast(Callable[..., Any], service.callback)

    def checked(request: ChangeState.Request, response: ChangeState.Response) -> Any:
        try:
            return change(request, response)
        except RuntimeError as error:  # RCLError has no public name
            node.get_logger().warning(f'no such transition now: {" ".join(str(error).split())}')
            response.success = False
            return response

    service.callback = checked


def offer_services(node: ProcessNode, joints: Sequence[Joint]) -> None:
    """Create ~/freeze_adaptation, ~/enable_compensation, ~/reset_estimates, ~/save_estimates."""
    unconfigured = 'the controller is unconfigured: configure it first'

    def offer(
        kind: type[SetBool] | type[Trigger], name: str,
        act: Callable[[ControlLoop, bool], None], done: tuple[str, str],
    ) -> None:
        """Act upon all loops; the bool, and which text it is done with, is what was asked for."""
        def serve(request: Any, response: Any) -> Any:
            wanted = getattr(request, 'data', True)
            if node.configured:
                for joint in joints:
                    act(joint.loop, wanted)
            response.success = node.configured
            response.message = done[wanted] if node.configured else unconfigured
            node.log.info(response.message)
            return response

        node.create_service(kind, name, serve)

    async def save(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        files = [joint.p.estimates.file for joint in joints]
        if not node.configured:
            response.message = unconfigured
        elif not any(files):
            response.message = 'estimates.file is empty, so there is nowhere to save: start with ' \
                '-p estimates.file:=PATH, or set it while unconfigured'
        elif not (writings := [each for joint in joints if (each := joint.save())]):
            response.message = 'nothing was learned yet'
        else:
            for writing in writings:
                # The loop goes on while the disk takes its time.
                written: Future = Future()
                writing.add_done_callback(written.set_result)
                await written
            why = '; '.join(filter(None, [writing.result() for writing in writings]))
            response.success = not why
            response.message = why or f'saved in {", ".join(files)}'
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
