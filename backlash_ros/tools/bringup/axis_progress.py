"""How far an axis has come, and how long to wait for its next sample."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, isfinite

from backlash_ros.tools.bringup.processes import RunError
from backlash_ros.tools.bringup.progress import ProgressDisplay, counts, number
from backlash_ros.tools.bringup.run_plan import AxisPlan

FIRST_SAMPLE_DEADLINE_S = 30.0  # of a driver that bringup has started
STALL_DEADLINE_S = 10.0  # without a new sample
LATE_DEADLINE_S = 10.0  # that a run in real time may take longer than it should


@dataclass
class AxisProgress:
    """How far an axis has come.

    made: samples so far. first: number of the sample that counts as the first one. moved: when
    the newest sample was heard of, on the monotonic clock [s]. published: samples and messages by
    topic that can have been heard of a simulated plant, once it is done; heard: those that the
    recorder has told of.
    """

    plan: AxisPlan
    display: ProgressDisplay
    made: int = 0
    first: int = 0
    began: float = 0.0
    moved: float = 0.0
    published: Mapping[str, int] | None = None
    heard: dict[str, int] = field(default_factory=dict)
    repeats: int = 0  # times in a row that the recorder has told of nothing that was unheard
    silence_told: bool = False

    @property
    def patience(self) -> float:
        """How long to wait for a new sample [s]."""
        # A plant of long sample periods may take its time.
        return STALL_DEADLINE_S + 2.0 * self.plan.sample_period

    @property
    def deadline(self) -> float:
        """When the last sample must have come, on the monotonic clock [s]."""
        if self.plan.samples == 0 or self.plan.parameters.get_bool('lockstep'):
            return inf
        return self.began + self.plan.samples * self.plan.sample_period + LATE_DEADLINE_S

    @property
    def complete(self) -> bool:
        """Whether all samples were made; a driver does not say so, the recorder hears it."""
        if self.plan.has_driver:
            return 0 < self.plan.samples <= self.made
        return self.published is not None

    @property
    def unheard(self) -> dict[str, int]:
        """What is missing of the published ones."""
        missing = {
            what: count - self.heard.get(what, 0) for what, count in (self.published or {}).items()
        }
        return {what: count for what, count in missing.items() if count > 0}

    def begin(self) -> None:
        """The time starts to run."""
        self.began = self.moved = time.monotonic()

    def take(self, progress: Mapping[str, object]) -> None:
        """Take in what the recorder says."""
        sample = number(progress, 'sample')
        if not isfinite(sample):
            return
        if self.made == 0:
            self.begin()
            # A driver may have been running before; a simulated plant begins with sample 0.
            self.first = int(sample) if self.plan.has_driver else 0
        made = int(sample) + 1 - self.first
        before = self.unheard
        self.heard = {'samples': made, **counts(progress, 'received')}
        self.repeats = self.repeats + 1 if self.unheard == before else 0
        if made > self.made:
            self.made, self.moved, self.silence_told = made, time.monotonic(), False
            self.display.show(progress, made)

    def check_pace(self) -> None:
        """Raise RunError for samples that do not come."""
        now = time.monotonic()
        plan = self.plan
        if plan.has_driver and self.made == 0:
            if not plan.driver_is_elsewhere and now > self.began + FIRST_SAMPLE_DEADLINE_S:
                raise RunError(plan.titled(
                    f'no sample within {FIRST_SAMPLE_DEADLINE_S:g} s: does the driver publish its '
                    f'output? see {plan.logs}; where it needs longer, start '
                    'it yourself (--driver none)'
                ))
            return
        if now > self.deadline and not self.complete:
            raise RunError(plan.titled(
                f'only {self.made} of {plan.samples} samples, '
                f'{LATE_DEADLINE_S:g} s after the end was due, see {plan.logs}'
            ))
        if now > self.moved + self.patience and not self.complete:
            at = f' after sample {self.first + self.made - 1}' if self.made else ''
            silence = plan.titled(f'no new sample for {self.patience:g} s{at}')
            if not plan.has_driver:
                raise RunError(f'{silence}, see {plan.logs}')
            # The controller knows what to do when a real plant falls silent.
            if not self.silence_told:
                self.silence_told = True
                self.display.say(f'bringup: {silence}, waiting for the driver')
