"""One joint of the controller: its loop, and what is said and kept of it."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from math import isfinite
from pathlib import Path

from rclpy.qos import QoSProfile

from backlash_ros.core.assembly import build_controller, first_guess
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.estimates_file import save_estimate, worth_saving
from backlash_ros.core.loop.command_history import awaited_reports
from backlash_ros.core.loop.control_loop import ControlLoop
from backlash_ros.core.loop.phase import Phase
from backlash_ros.core.loop.sample_counter import Output
from backlash_ros.core.parameters import NOISE, Parameters
from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.nodes.control.diagnosis import Diagnosis, counts_of
from backlash_ros.nodes.control.publishing import ModelPublisher
from backlash_ros.nodes.control.rivals import RivalWatch
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.process import ProcessNode


class EstimateSaver:
    """Writes estimates to one file, one writing after the other, without holding up the loop.

    file: path, empty for none.
    """

    def __init__(self, file: str, complain: Callable[[str], object]) -> None:
        self.file, self._complain = file, complain
        # A disk that is slow to confirm a file would cost samples.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='estimates')
        self._saved_at = time.monotonic()

    def save(self, estimate: Estimate, p: Parameters) -> Future[str]:
        """Begin to save; the result says why it failed, empty if it did not."""
        self._saved_at = time.monotonic()
        return self._thread.submit(self._write, estimate, p)

    def is_due(self, period_s: float) -> bool:
        """Whether the newest saving is so long ago; never with 0."""
        return 0.0 < period_s < time.monotonic() - self._saved_at

    def close(self) -> None:
        """Wait until everything is written."""
        self._thread.shutdown()

    def _write(self, estimate: Estimate, p: Parameters) -> str:
        try:
            save_estimate(Path(self.file), estimate, p)
        except OSError as error:
            text = f'estimates.file={self.file!r} cannot be written: {error.strerror}'
            self._complain(text)
            return text
        return ''


class FirstCommand:
    """Which v the first command goes on from, and whether the loop may begin with it.

    before: v before a cleanup, None without one.
    """

    def __init__(self, node: ProcessNode, io: DriverIo, joint: str) -> None:
        self._node, self._io, self._joint = node, io, joint
        self.before: float | None = None
        self._warned: set[str] = set()  # texts
        self._unanswered = 0  # outputs that were not answered because v was not known yet

    def v_at_start(self, p: Parameters) -> float | None:
        """The v that acts as far as this node can know, None if it cannot."""
        if self.before is not None:
            return self.before
        # In lockstep there is the simulated plant alone, which begins at 0.
        return p.control.initial if isfinite(p.control.initial) and not p.lockstep else None

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
        self._unanswered += 1
        if self._io.has_reports and self._unanswered <= awaited_reports(p):
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


class Joint:
    """What the controller has of each joint; a single one is nameless.

    p: its parameters. loop: None while the node is unconfigured. reference_at: when the newest y_m
    came, on the steady clock [s].
    """

    def __init__(
        self, node: ProcessNode, name: str, p: Parameters, io: DriverIo, references: QoSProfile,
    ) -> None:
        self.name, self.p = name, p
        self.loop: ControlLoop | None = None
        self.reference_at: float | None = None
        self.model = ModelPublisher(node, name)
        self.first_command = FirstCommand(node, io, name)
        self.saver = EstimateSaver(p.estimates.file, node.log.error)
        self._node = node
        self._told: Status | None = None  # the newest one that /diagnostics has
        self._diagnosis = Diagnosis(node, io, name, p.io.joint, references)

    def begin(self, loop: ControlLoop, before: Estimate) -> None:
        """Take a new loop."""
        self.loop = loop
        self.model.publish(loop)
        if before.learned:
            self._node.log.info(
                f'going on with the estimates in {self.saver.file}: m={before.m:.6g}, '
                f'c_r={before.c_r:.6g}, c_l={before.c_l:.6g}'
            )

    def end(self) -> None:
        """Give the loop up, but remember its v."""
        if self.loop is not None and self.loop.knows_v:
            self.first_command.before = self.loop.v
        self.loop = None

    def follow(self, step: ControlStep, was_silent: bool) -> bool:
        """Tell of a step; returns whether there is something new to say in /diagnostics."""
        assert self.loop is not None
        self.model.follow(self.loop, self.p.sample_period)
        news = was_silent or step.estimate.status != self._told
        self._told = step.estimate.status
        return news

    def is_overdue(self) -> bool:
        """Whether its driver has been silent for too long, and that is new."""
        loop = self.loop
        return loop is not None and loop.heard_at is not None \
            and loop.phase in (Phase.BEGINS, Phase.RUNS) \
            and 0.0 < self.p.timeout.plant_output < time.monotonic() - loop.heard_at

    def check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the running loop cannot take up."""
        build_controller(p, first_guess(p))
        loop = self.loop
        if loop is not None and p[NOISE] != self.p[NOISE] \
                and NOISE not in loop.core.estimator.RETUNED:
            raise ParameterError(
                NOISE, p[NOISE], f'is not taken up live by {p.estimator.law}',
                'clean the node up, set it, and configure again',
            )

    def take_up(self, p: Parameters) -> None:
        """Use other values."""
        self.p = p
        if self.loop is not None:
            self.loop.take_up(p)
        else:
            self.saver.file = p.estimates.file

    def save(self) -> Future[str] | None:
        """Begin to save the estimates; None where there is nothing worth it, or nowhere to."""
        if self.loop is None or not self.saver.file or not worth_saving(self.loop.estimate):
            return None
        return self.saver.save(self.loop.estimate, self.p)

    def save_now_and_then(self) -> None:
        """Begin to save as often as estimates.save_period says."""
        if self.saver.is_due(self.p.estimates.save_period):
            self.save()

    def diagnose(self, rivals: RivalWatch, active: bool) -> None:
        """Publish what is going on to /diagnostics."""
        self._diagnosis.tell(self.loop, self.p, self.reference_at, rivals, active)

    def sum_up(self) -> None:
        """Say in the log what was counted."""
        if self.loop is not None:
            said = ', '.join(
                f'{key}: {count}' for key, count in counts_of(self.loop).items()
                if count or key == 'samples'
            )
            self._node.log.info(f'{self.name}: {said}' if self.name else said)
