"""A process node that is managed: unconfigured, inactive, active, finalized."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from backlash_ros.core.parameters import ParameterError
from backlash_ros.nodes.runtime.process import ProcessNode


class ManagedNode(LifecycleNodeMixin, ProcessNode):
    """A node with the life cycle of ROS 2; what a state means, its subclasses say.

    Design: https://design.ros2.org/articles/node_lifecycle.html
    """

    active = False

    def __init__(self, executable: str) -> None:
        """Raises ParameterError."""
        ProcessNode.__init__(self, executable, reconfigurable=True)
        LifecycleNodeMixin.__init__(self)
        self._refuse_what_does_not_fit()

    def configure(self) -> None:
        """Make everything that is needed to work; raises ParameterError."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """End the work; called before the end of the process as well if it was active."""

    def cleanup(self) -> None:
        """Undo configure."""

    def start(self) -> None:
        """Configure and activate without being asked."""
        untyped: Any = self
        untyped.trigger_configure()
        untyped.trigger_activate()

    def finish(self) -> None:
        self._end_work()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._tried(self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        result = self._tried(self.activate)
        self.active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._tried(self._end_work)

    on_shutdown = on_deactivate

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        return self._tried(self.cleanup)

    def _end_work(self) -> None:
        if self.active:
            self.active = False
            self.deactivate()

    def _tried(self, action: Callable[[], None]) -> TransitionCallbackReturn:
        # rclpy itself would swallow the exception without a word.
        try:
            action()
        except ParameterError as error:
            self.log.error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _refuse_what_does_not_fit(self) -> None:
        """Answer a transition that the present state does not have, instead of ending of it."""
        service = next(s for s in self.services if s.srv_type is ChangeState)
        change = cast(Callable[..., Any], service.callback)

        def checked(request: ChangeState.Request, response: ChangeState.Response) -> Any:
            try:
                return change(request, response)
            except RuntimeError as error:  # RCLError has no public name
                self.log.warning(f'no such transition now: {" ".join(str(error).split())}')
                response.success = False
                return response

        service.callback = checked
