"""What the tasks of the fit share: the record, the fit of it, and when to do what next.

A task is a generator that stops between its pieces and returns whether it leaves a fit that is to
be published (schedule.py names them).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field
from math import inf, log

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.estimation.constants import (
    BLOCK,
    FIRST_SEARCH,
    GROWTH,
    LONGEST,
    MEMORIES_SEARCHED,
    RECOVERED,
    REVERSALS,
    SEARCH_GROWTH,
    SEARCHED,
)
from backlash_ros.core.estimation.fit.arrival import arrival
from backlash_ros.core.estimation.fit.crossings import Crossings
from backlash_ros.core.estimation.fit.learned_error import Learned, as_told, likelier
from backlash_ros.core.estimation.fit.pace import Pace
from backlash_ros.core.estimation.fit.prior import Prior, drifted
from backlash_ros.core.estimation.fit.record import Record
from backlash_ros.core.estimation.fit.relabelling import Fitted
from backlash_ros.core.estimation.fit.solution import Around, Solution
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.moving_horizon.acceptance import usable
from backlash_ros.core.estimation.observer.record_attribution import Attributed
from backlash_ros.core.estimation.regression.play import Labels, Start

Array = NDArray[np.float64]
Task = Generator[None, None, bool]

CAPACITY = 2 * LONGEST  # samples kept: those that are fitted, and those that come meanwhile


@dataclass
class Acquisition:
    """The search for a backlash that is not known.

    next_at: sample at which to search. inherited: what is believed unless the samples deny it.
    candidate: what the last search found. rejected: last fit of a search that gave no estimate.
    one_sided: labels of what was found twice, whose side has not changed often enough: until it
    has, or sample `again_at` has come, another search would find the same.
    """

    next_at: int = FIRST_SEARCH
    inherited: Estimate | None = None
    candidate: Prior | None = None
    rejected: Fitted | None = None
    one_sided: Start | None = None
    again_at: int = 0


@dataclass
class Learning:
    """The record and the fit of it.

    told: around what the first fit is made, with G as told. told_walk: of u, a first guess. drift:
    random walk of m, c_r, c_l per square root of a sample, shape (3,). around: what the next fit is
    made around. current: the fit, None while it is searched for. reason: why there is no estimate.
    refit_at: length of the record at which all of it is refitted; moved_at: from which it is
    reason to do so that gap or poles of G have `strayed` from those that the fit was made around.
    contradicted_from: sample from which the fit does not hold;
    consistent: samples that do fit since then; agreed: those before it; next_try: sample at which
    to look for an explanation again. changed: what theta seems to have become. refitted: whether it
    was refitted since the record contradicts itself. unconfirmed: whether the estimate was learned
    before, and the samples merely do not deny it; supported: whether they alone are precise enough
    to speak for it.
    contradiction: fit of samples that nothing explains, around what was known; None while there are
    none. held: covariance (3, 3) of the m, c_r, c_l that are published, None before. learned: the G
    of low order that explains y. reattributed, outliers: commands that turned out to be others, and
    readings that were left out, so far.
    """

    bounds: Bounds
    told: Around
    told_walk: float
    drift: Array
    around: Around
    pace: Pace = field(default_factory=Pace)
    record: Record = field(default_factory=lambda: Record(CAPACITY))
    acquisition: Acquisition = field(default_factory=Acquisition)
    current: Fitted | None = None
    reason: Status = Status.ACQUIRING
    refit_at: float = 0.0
    moved_at: int = 0
    strayed: bool = False
    contradicted_from: int | None = None
    consistent: int = 0
    agreed: int = 0
    next_try: int = 0
    refitted: bool = False
    changed: Prior | None = None
    unconfirmed: bool = False
    supported: bool = False
    contradiction: Fitted | None = None
    held: Array | None = None
    reattributed: int = 0
    outliers: int = 0
    learned: Learned = field(init=False)

    def __post_init__(self) -> None:
        error = self.told.error
        self.learned = as_told(error.model, error.count)

    @property
    def expects_changes(self) -> bool:
        """Whether m, c_r, c_l drift as told: a change is believed at once."""
        return any(self.drift.tolist())  # asked at every sample: faster than by NumPy

    @property
    def fit(self) -> Fitted:
        """The fit, of tasks that begin once there is one."""
        assert self.current is not None
        return self.current

    @property
    def free(self) -> Around:
        """Around the G of now, with nothing else taken for known."""
        return self.around._replace(prior=None, most=inf, walk=0.0)

    @property
    def unchanged(self) -> Around:
        """Free, but for G: another backlash leaves it as well known as it was."""
        if not self.around.inherited:
            return self.free
        return self.free._replace(most=self.fit.solution.posterior.scale)

    @property
    def searched(self) -> int:
        """Newest samples that the first search looks at: G has forgotten what was before them."""
        return min(max(SEARCHED, MEMORIES_SEARCHED * self.around.model.memory), LONGEST)

    @property
    def widest(self) -> float:
        """Largest gap that the bounds allow."""
        return self.bounds.c_r[1] - self.bounds.c_l[0]

    def taken_since(self, number: int) -> tuple[Array, Array]:
        """v and y of the samples from this number on that the fit has taken in.

        Those that wait have not been compared with it yet, and may contradict it.
        """
        v, y = self.record.since(number)
        count = len(v) - self.waiting
        return v[:count], y[:count]

    def believe(self, found: Attributed, first: int) -> None:
        """Let these commands have acted from sample `first` on, and lose the outliers."""
        self.reattributed += self.record.attribute(first, found.v)
        self.leave_out(first, found.outliers)

    def leave_out(self, first: int, outliers: NDArray[np.bool_]) -> None:
        """Count these of the y from sample `first` on as outliers, and as lost."""
        self.outliers += int(np.count_nonzero(outliers))
        self.record.lose(first + np.flatnonzero(outliers))

    @property
    def waiting(self) -> int:
        """Samples of the record that no fit has taken in yet."""
        taken = self.current.fit.length if self.current is not None else 0
        return len(self.record) - taken

    def beginnings(self, around: Around) -> list[Around]:
        """This one, and that of the G that was told where it is another one.

        A G that was moved step by step may have gone astray.
        """
        if around.error is self.told.error:
            return [around]
        return [around, around._replace(error=self.told.error)]

    def reversed_often(self, fit: WindowFit | Labels) -> bool:
        """Whether the engaged side has changed so often that no lag passes for a gap."""
        return self.around.error.count == 0 or fit.reversals >= REVERSALS

    def may_have_reversed(self, v: Array) -> bool:
        """The same, as far as v (N,) itself has turned so often."""
        moves = np.sign(np.diff(v))
        turns = np.count_nonzero(np.diff(moves[moves != 0.0]))
        return self.around.error.count == 0 or turns >= REVERSALS

    def usable(self, result: Fitted, share: float = 1.0) -> Crossings | None:
        """The crossings of a fit that is precise enough, see acceptance.py."""
        return usable(result, self.bounds, share)

    @property
    def confirmed(self) -> bool:
        """Whether the samples speak for what is published."""
        known = not self.unconfirmed or self.supported
        return self.current is not None and known

    def drifts_more(self, solution: Solution, samples: int) -> bool:
        """Whether drift over so many samples is more than the noise leaves unknown."""
        found = solution.crossings
        if found is None or not self.expects_changes or samples < BLOCK[1]:
            return False
        return bool(np.any(self.drift**2 * (samples / 3.0) > np.diag(found.cov)))

    def drifted(self, known: Prior, samples: int) -> Prior:
        """What was known of theta after so many samples of drift."""
        return drifted(*known, self.drift, samples)

    def begin_acquisition(self, inherited: Estimate | None) -> None:
        """Look for the backlash afresh; inherited: what is believed unless the samples deny it."""
        self.current = None
        self.acquisition = Acquisition(self.record.end + FIRST_SEARCH, inherited)
        self.refit_at, self.moved_at, self.strayed = 0.0, 0, False
        self.refitted = False
        self.contradicted_from = self.changed = None
        self.unconfirmed = False
        if inherited is None:
            self.contradiction = None

    def go_on_from(
        self, result: Fitted, first: int, changed: bool = False,
    ) -> bool:
        """Go on from this fit of the record from sample `first` on; it is to be published.

        changed: whether it is of a plant that has changed.
        """
        if result.around.error.count and not result.around.inherited:
            self.learned = likelier(result.fit, result.solution, self.learned)
        self.current, self.around = result, result.around
        if result.around.prior is None:
            self.unconfirmed = False
        self.record.forget_before(first)
        # As long as the gap may be another one the search for it goes on.
        growth = SEARCH_GROWTH if result.fit.gap_spread > 0.0 else GROWTH
        self.refit_at = next_length(result.fit.length, growth)
        self.moved_at, self.strayed = result.fit.length + BLOCK[1], False
        self.contradicted_from = self.changed = self.acquisition.rejected = None
        self.contradiction = None
        if changed:
            self.consistent = RECOVERED if self.expects_changes else 0
        return True

    def restart(self, start: Start) -> None:
        """Begin a new record with what the old one says as a prior."""
        current, record = self.current, self.record
        record.forget_before(record.end)
        if current is None:
            self.begin_acquisition(self.acquisition.inherited)
            return
        self.around = self.around._replace(prior=arrival(current, current.contested))
        fit = current.fit.restarted(self.around, start)
        self.current = Fitted(fit, fit.solve())
        self.refit_at = FIRST_SEARCH
        self.contradicted_from = None


def next_length(length: int, growth: float) -> float:
    """Length of the record at its next refit, in equal steps that end at the longest one."""
    if length >= LONGEST:
        return LONGEST
    steps = max(round(log(LONGEST / length) / log(growth)), 1)
    return float(length * (LONGEST / length) ** (1.0 / steps))
