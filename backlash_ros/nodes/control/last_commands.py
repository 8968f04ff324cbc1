"""How v comes to its end in real time: while the driver is silent, and when the node stops."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

from rclpy.duration import Duration
from rclpy.timer import Timer

from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.joint_loops import JointLoops
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.messages import DIAGNOSTICS_PERIOD_S
from backlash_ros.nodes.runtime.process import ProcessNode

SHORTEST_STEP_S = 1e-3  # between two commands of a ramp to zero
CONFIRMED_WITHIN_S = 0.1  # longest wait for the driver to confirm the last command


class LastCommandSender:
    """Sends the commands that `on_timeout` and `on_stop` name, one every sample period."""

    def __init__(self, node: ProcessNode, io: DriverIo) -> None:
        self._node, self._io = node, io
        self._ramp: Timer | None = None
        self._commands: dict[ControlLoop, Iterator[float]] = {}  # of loops that are on their way

    @property
    def _step_s(self) -> float:
        return max(self._node.settings.sample_period, SHORTEST_STEP_S)

    def begin(self, loops: JointLoops, ending: Iterable[ControlLoop], action: str) -> None:
        """Send those of some loops from a timer while the node goes on."""
        self._commands |= {loop: loop.last_commands(action) for loop in ending}

        def send_next() -> None:
            for loop, commands in list(self._commands.items()):
                v = next(commands, None)
                if v is None:
                    self.end(loop)
                else:
                    loop.send(v)
            loops.send()

        if self._ramp is None:
            self._ramp = self._node.create_timer(
                self._step_s, send_next, clock=self._node.steady_clock
            )

    def end(self, *loops: ControlLoop) -> None:
        """Send no more of them, of these loops or, where none is named, of all."""
        for loop in loops or list(self._commands):
            self._commands.pop(loop, None)
        if self._ramp is not None and not self._commands:
            self._node.destroy_timer(self._ramp)
            self._ramp = None

    def send_all(
        self, loops: JointLoops, action: str, longest_s: float, tell: Callable[[], None],
    ) -> None:
        """Send those of all loops now; v comes to rest where that takes longer than longest_s [s].

        So it does at a SIGTERM that comes meanwhile: whoever sends it will kill the process next.
        tell: called at least every second, so that who stands down does not take this node for
        gone.
        """
        under_way = {
            loop: loop.last_commands(action) for loop in loops.by_name.values()
            if loop.last is not None and not loop.standing_down
        }
        told = time.monotonic()
        deadline, step_s = told + longest_s, self._step_s
        cut_short = ''
        held: tuple[ControlLoop, ...] = ()
        while True:
            for loop, commands in list(under_way.items()):
                v = next(commands, None)
                if v is not None:
                    loop.send(v)
                if v is None or (v == loop.zero and loop.core.motion.move == 0.0):
                    del under_way[loop]
            loops.send()
            if not under_way:
                break
            if not cut_short:
                if self._node.urged.is_set():
                    cut_short = 'SIGTERM came before it reached zero'
                elif time.monotonic() + step_s > deadline:
                    cut_short = f'it did not reach zero within timeout.ramp={longest_s:g} s'
                if cut_short:
                    under_way = {loop: loop.last_commands('hold') for loop in under_way}
                    held = tuple(under_way)
                    continue
            time.sleep(step_s) if cut_short else self._node.urged.wait(step_s)
            if time.monotonic() > told + DIAGNOSTICS_PERIOD_S:
                told = time.monotonic()
                tell()
        if cut_short:
            for loop in held:
                self._node.log.warning(f'v={loop.v:.6g} is held: {cut_short}')
        confirmed_within = Duration(nanoseconds=int(CONFIRMED_WITHIN_S * 1e9))
        self._io.publisher.wait_for_all_acked(confirmed_within)
