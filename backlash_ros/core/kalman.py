"""Estimation of the backlash from v and y alone, at the statistical limit.

A GapSearch finds the gap and hands over a bank of Kalman filters. This class watches over it:
it gates outliers, freezes what the data cannot tell, and starts a new search when the data
contradict the estimate. docs/estimation.md explains the method and measures it.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

from backlash_ros.core.crossings import Crossings, crossings_of
from backlash_ros.core.estimator import Bounds, Estimate, Interval, Status
from backlash_ros.core.gap_bank import GapBank
from backlash_ros.core.gap_search import GapSearch, SearchSettings, fine_gaps
from backlash_ros.core.state_model import StateModel

GATE = 6.0  # standard deviations of an innovation beyond which y is an outlier
REFUSED_IN_A_ROW = 5  # outliers in a row that mean a contradiction, not outliers
NIS_LIMIT = 3.0  # mean normalised innovation squared that contradicts an estimate
NIS_TRUSTED = 2.0  # mean normalised innovation squared below which an estimate is consistent
PROVEN = 25  # samples a new search must be consistent for before it replaces an estimate
UNEXCITED_AFTER = 150  # samples in the gap after which nothing more can be learned
NO_DATA_AFTER = 20  # lost samples in a row that are worth a status
UNDECIDED_AFTER = 100  # samples after which a search without a sign of engagement says so
PRECISE_SLOPE, PRECISE_GAP = 0.2, 0.3  # relative deviations below which an estimate is published


class KalmanEstimator:
    """Learns (m, c_r, c_l) from y alone with a bank of Kalman filters over the gap width.

    noise_std: standard deviation of the noise on y. drift_std: random walk of m, c_r, c_l per
    square root of a second. Nothing else needs tuning.
    """

    lag = 1

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, noise_std: float,
        drift_std: tuple[float, float, float], sample_period: float,
    ) -> None:
        self.estimate = initial
        self.outliers = 0
        root = sample_period**0.5
        drift = (drift_std[0] * root, drift_std[1] * root, drift_std[2] * root)
        self._settings = SearchSettings(model, bounds, initial, noise_std, drift)
        self._bounds = bounds
        self._drifts = any(drift_std)
        self._search = _Watched(GapSearch(self._settings))
        self._challenger: _Watched | None = None
        self._known = False  # an estimate was published
        self._lost_in_a_row = 0

    @property
    def u_hat(self) -> float:
        """u that acted before the newest y, under the most likely gap; nan before any is known."""
        fine = self._search.search.fine
        return fine.u_hat() if fine is not None else nan

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction; nan where y(k) was lost or nothing is known yet."""
        fine = self._search.search.fine
        return fine.innovation if fine is not None and self._lost_in_a_row == 0 else nan

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        watched = self._search
        if not watched.add(y, interval.v):
            self.outliers += 1
        if self._known and watched.contradicted:
            self._challenge(y, interval.v)
        elif self._challenger is not None and not watched.contradicted:
            self._challenger = None
        self._publish()

    def _challenge(self, y: float | None, v: float) -> None:
        """Search afresh beside an estimate that the data contradict."""
        if self._challenger is None or self._challenger.hopeless:
            self._challenger = _Watched(GapSearch(self._settings))
        challenger = self._challenger
        challenger.add(y, v)
        if challenger.consistent_for >= PROVEN and self._usable(challenger) is not None:
            self._search, self._challenger = challenger, None

    def _usable(self, watched: _Watched) -> Crossings | None:
        """The estimate of a search if it is precise and within the bounds by its deviations."""
        found = watched.found
        if found is None or found.std_m > PRECISE_SLOPE * found.m:
            return None
        if not found.std_gap < PRECISE_GAP * found.gap:
            return None
        values = (found.m, found.c_r, found.c_l)
        slack = (found.std_m, found.std_c_r, found.std_c_l)
        inside = self._bounds.project(*values)
        if any(
            abs(a - b) > 3.0 * s + 1e-9 * abs(b)
            for a, b, s in zip(values, inside, slack, strict=True)
        ):
            return None
        return found

    def _publish(self) -> None:
        status = self._status()
        found = None if status.frozen else self._usable(self._search)
        if found is None:
            if self.estimate.status != status:
                self.estimate = replace(self.estimate, status=status)
            return
        self._known = True
        m, c_r, c_l = self._bounds.project(found.m, found.c_r, found.c_l)
        self.estimate = Estimate(
            m, c_r, c_l, self.estimate.f, found.std_m, found.std_c_r, found.std_c_l,
            Status.TRACKING,
        )

    def _status(self) -> Status:
        watched = self._search
        if self._lost_in_a_row >= NO_DATA_AFTER:
            return Status.NO_DATA
        if self._known and watched.contradicted:
            return Status.INCONSISTENT
        fine = watched.search.fine
        if fine is None:
            search = watched.search
            waited = search.samples >= UNDECIDED_AFTER and not search.excited
            return Status.NOT_EXCITED if waited else Status.ACQUIRING
        if fine.since_engaged > UNEXCITED_AFTER:
            return Status.NOT_EXCITED
        return Status.TRACKING if self._known else Status.ACQUIRING


class _Watched:
    """A search whose fine bank is gated, frozen and watched for contradictions."""

    def __init__(self, search: GapSearch) -> None:
        self.search = search
        self.consistent_for = 0  # samples
        self.contradicted = False
        self._proven = False
        self._refused = 0

    @property
    def found(self) -> Crossings | None:
        """Estimate of the leading hypothesis, None before there is one."""
        fine = self.search.fine
        if fine is None or not fine.active or fine.nis > NIS_TRUSTED:
            return None
        return crossings_of(fine.theta[fine.leader], fine.theta_cov[fine.leader])

    @property
    def hopeless(self) -> bool:
        """Whether this search has had its chance."""
        return self.search.samples > 400 and self.consistent_for == 0

    def add(self, y: float | None, v: float) -> bool:
        """Take in a sample; return False if y was refused as an outlier."""
        fine, accepted = self.search.fine, True
        if fine is not None:
            fine.predict(v)
            if y is not None:
                learn = fine.since_engaged <= UNEXCITED_AFTER and not self.contradicted
                accepted = fine.correct(y, GATE if self._proven else inf, learn)
                self._judge(fine, accepted)
            if self.search.full:
                self._follow(fine)
        self.search.add(y, v, accepted)
        return accepted

    def _judge(self, fine: GapBank, accepted: bool) -> None:
        self._refused = 0 if accepted else self._refused + 1
        trusted = accepted and fine.nis < NIS_TRUSTED
        self.consistent_for = self.consistent_for + 1 if trusted else 0
        self._proven = self._proven or self.consistent_for >= PROVEN
        if self._refused >= REFUSED_IN_A_ROW or (self._proven and fine.nis > NIS_LIMIT):
            self.contradicted = True
        elif fine.nis < NIS_TRUSTED:
            self.contradicted = False

    def _follow(self, fine: GapBank) -> None:
        """Let the hypotheses follow the estimate once replays have ended."""
        if fine.since_engaged == 0:
            return
        found = self.found
        if found is not None and found.gap > 0.0:
            fine.move_gaps(fine_gaps(found))
