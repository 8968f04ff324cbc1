"""Which v the first command goes on from, and what has to be known before it."""

from __future__ import annotations

from math import isfinite

from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.report_use import awaited_reports
from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.core.parameters import Parameters
from backlash_ros.nodes.control.reports import Reports
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.spin import ProcessNode


class FirstCommand:
    """Decides when the loop may begin.

    reports: those of the driver, None in lockstep. before: v before a cleanup, None without one.
    """

    def __init__(
        self, node: ProcessNode, io: DriverIo, reports: Reports | None, joint: str = '',
    ) -> None:
        self._node, self._io, self._reports, self._joint = node, io, reports, joint
        self.before: float | None = None
        self._warned: set[str] = set()  # texts
        self._unanswered = 0  # outputs that were not answered because v was not known yet

    def v_at_start(self, p: Parameters) -> float | None:
        """The v that acts as far as this node can know, None if it cannot."""
        if self.before is not None:
            return self.before
        initial = p.control.initial
        # In lockstep there is the simulated plant alone, which begins at 0.
        return initial if isfinite(initial) and self._reports is not None else None

    def may_follow(self, loop: ControlLoop, output: Output, p: Parameters) -> bool:
        """Whether it is known from which v the first command goes on, or waiting is in vain."""
        if self._io.is_simulated:
            return True
        if missing := p.missing_limits:
            self._warn_once(
                f'{", ".join(missing)}: not set, so nothing keeps v within what the actuator '
                'bears: set them'
            )
        if loop.learn_v(output.stamp_ns):
            return True
        reported = self._reports is not None and self._reports.publishers > 0
        self._unanswered += 1
        if reported and self._unanswered <= awaited_reports(p):
            return False
        if self._io.in_joint_space:
            # v and y are the same angle but for the gap: the joint holds where it stands.
            loop.go_on_from(output.y / loop.estimate.m)
            return True
        self._warn_once(
            'nobody says which v acts now, so the first command goes on from 0: publish '
            f'{self._io.topics.applied}, or set control.initial'
        )
        return True

    def _warn_once(self, text: str) -> None:
        if text not in self._warned:
            self._warned.add(text)
            self._node.log.warning(f'{self._joint}: {text}' if self._joint else text)
