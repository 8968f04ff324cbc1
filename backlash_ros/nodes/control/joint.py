"""One joint of the controller: its loop, and what is said and kept of it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from math import isfinite
from pathlib import Path

from backlash_ros.core.assembly import build_controller, first_guess
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimates_file import save_estimate, worth_saving
from backlash_ros.core.loop.control_loop import ControlLoop, Driver
from backlash_ros.core.loop.diagnosis import (
    OF_MESSAGES,
    Finding,
    Level,
    Neighbours,
    figures_of_loop,
    findings_of,
)
from backlash_ros.core.loop.loop_statistics import Lately
from backlash_ros.core.loop.sample_counter import Timing
from backlash_ros.core.parameters import NOISE, ParameterError, Parameters
from backlash_ros.nodes.control.diagnosis import counts_of, details_of, missing_joint, values_of
from backlash_ros.nodes.control.publishing import ModelPublisher
from backlash_ros.nodes.runtime.driver_io import DriverIo
from backlash_ros.nodes.runtime.messages import DiagnosticsPublisher
from backlash_ros.nodes.runtime.process import ProcessNode


class Joint:
    """What the controller has of each joint; a single one is nameless.

    p: its parameters. loop: None while the node is unconfigured. v: the command that acts as far as
    this node can know, None if it cannot. told: the state that /diagnostics has. saved_at: when
    estimates were saved last, on the steady clock [s].
    """

    def __init__(self, node: ProcessNode, name: str, p: Parameters, io: DriverIo) -> None:
        self.name, self.p = name, p
        self.loop: ControlLoop | None = None
        # In lockstep there is the simulated plant alone, which begins at 0.
        initial = p.control.initial
        self.v = initial if isfinite(initial) and not p.lockstep else None
        self.model = ModelPublisher(node, name)
        self._node, self._io = node, io
        self.told: object = None
        self._lately = Lately()
        self._diagnostics = DiagnosticsPublisher(
            node, p.io.joint or io.publisher.topic_name, part=name
        )
        # A disk that is slow to confirm a file would cost samples; one writing follows the other.
        self._writer = ThreadPoolExecutor(1, thread_name_prefix='estimates')
        self.saved_at = time.monotonic()

    @property
    def driver(self) -> Driver:
        """What its loop can ask about the driver; the simulated plant has nothing to be asked."""
        io = self._io

        @cache
        def warn_once(text: str) -> None:
            if not io.is_simulated:
                self._node.log.warning(f'{self.name}: {text}' if self.name else text)

        return Driver(
            io.now_ns, lambda: io.has_reports and not io.is_simulated, io.topics.applied, warn_once
        )

    @property
    def state(self) -> object:
        """Of which every change is worth a message in /diagnostics."""
        return self.loop and (self.loop.phase, self.loop.estimate.status)

    def begin(self, loop: ControlLoop, before: Estimate) -> None:
        """Take a new loop."""
        self.loop = loop
        self.model.publish(loop, self.p)
        if before.learned:
            self._node.log.info(
                f'going on with the estimates in {self.p.estimates.file}: m={before.m:.6g}, '
                f'c_r={before.c_r:.6g}, c_l={before.c_l:.6g}'
            )

    def end(self) -> None:
        """Give the loop up, but remember its v."""
        if self.loop is not None:
            self.loop.core.close()
            if self.loop.knows_v:
                self.v = self.loop.v
        self.loop = None

    def check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the running loop cannot take up."""
        build_controller(p, first_guess(p))
        if self.loop is not None and p[NOISE] != self.p[NOISE] \
                and NOISE not in self.loop.core.estimator.RETUNED:
            raise ParameterError(
                NOISE, p[NOISE], f'is not taken up live by {p.estimator.law}',
                'clean the node up, set it, and configure again',
            )

    def take_up(self, p: Parameters) -> None:
        """Use other values."""
        self.p = p
        if self.loop is not None:
            self.loop.take_up(p)

    def save(self) -> Future[str] | None:
        """Begin to save the estimates; None where there is nothing worth it, or nowhere to.

        The result says why it failed, empty if it did not.
        """
        p, estimate = self.p, self.loop.estimate if self.loop else None
        if estimate is None or not p.estimates.file or not worth_saving(estimate):
            return None
        self.saved_at = time.monotonic()

        def write() -> str:
            try:
                save_estimate(Path(p.estimates.file), estimate, p)
            except OSError as error:
                text = f'estimates.file={p.estimates.file!r} cannot be written: {error.strerror}'
                self._node.log.error(text)
                return text
            return ''

        return self._writer.submit(write)

    def diagnose(
        self, around: Neighbours, timing: Timing, claim: Mapping[str, object], active: bool,
    ) -> None:
        """Publish what is going on to /diagnostics. claim: what the node says in each of them."""
        loop, p, publish = self.loop, self.p, self._diagnostics.publish
        if loop is None:
            publish(Finding(Level.OK, 'unconfigured', 'unconfigured'), claim)
            return
        values = {**values_of(loop, timing), **claim}
        if not active:
            text = f'inactive: no {self._io.topics.control} is published'
            publish(Finding(Level.OK, 'inactive', text), values)
            return
        gained = self._lately.gained(loop.counted, time.monotonic())
        figures = figures_of_loop(loop, p, timing, gained, around)
        findings = [*missing_joint(self._io, self.name, p), *findings_of(figures)]
        # The likeliest cause at the highest level that was found.
        worst = max(findings, key=lambda finding: finding.level > Level.OK)
        worst = worst._replace(level=max(finding.level for finding in findings))
        # What is true of all joints the first one says in the log.
        first = self._node.settings.joint_names[0]
        logs = self.name == first or worst.kind not in OF_MESSAGES
        publish(worst, {**details_of(findings, around), **values}, logs)

    def close(self) -> None:
        """Wait until everything is written, and say in the log what was counted."""
        self._writer.shutdown()
        if self.loop is not None:
            said = ', '.join(
                f'{key}: {count}' for key, count in counts_of(self.loop).items()
                if count or key == 'samples'
            )
            self._node.log.info(f'{self.name}: {said}' if self.name else said)
