"""Estimation of the backlash from v and y alone, at the statistical limit.

A GapSearch finds the gap and hands over a bank of Kalman filters. This class watches over it:
it gates outliers, freezes what the data cannot tell, and starts a new search when the data
contradict the estimate. docs/estimation.md explains the method and measures it.
"""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.bank_making import SearchSettings
from backlash_ros.core.estimation.baselines.fixed import FixedBacklash
from backlash_ros.core.estimation.crossings import Crossings
from backlash_ros.core.estimation.protocol import Bounds, Estimate, Interval, Status
from backlash_ros.core.gap_bank import GapBank
from backlash_ros.core.gap_choice import fine_gaps
from backlash_ros.core.gap_search import GapSearch
from backlash_ros.core.state_model import StateModel

GATE = 6.0  # standard deviations of an innovation beyond which y is an outlier
REFUSED_IN_A_ROW = 5  # outliers in a row that mean a contradiction, not outliers
NIS_LIMIT = 3.0  # mean normalised innovation squared that contradicts an estimate
NIS_TRUSTED = 2.0  # mean normalised innovation squared below which an estimate is consistent
PROVEN = 25  # samples a new search must be consistent for before it replaces an estimate
RESTART_AFTER = 150  # inconsistent samples after which a search begins afresh
RESTART_IN_VAIN = 50  # the same while no estimate is known, so that nothing good can be lost
NO_DATA_AFTER = 20  # lost samples in a row that are worth a status
UNDECIDED_AFTER = 100  # samples after which a search says that nothing usable comes out
LONGEST_DOUBT = 40  # samples for which a first estimate may be held back
PRECISE_SLOPE, PRECISE_GAP = 0.2, 0.3  # relative deviations below which an estimate is published
ADOPTED_SLOPE, ADOPTED_GAP = 0.008, 0.05  # those below which it replaces an older one at once
ADOPTED_AFTER = 300  # consistent samples after which it does so in any case


class KalmanEstimator:
    """Learns (m, c_r, c_l) from y alone with a bank of Kalman filters over the gap width.

    noise_std, input_noise_std: standard deviations of white noise on y and on u. drift_std: random
    walk of m, c_r, c_l per square root of a second. Nothing else needs tuning. initial: a first
    guess, or with its deviations what was learned before. observer: gives the state of G until
    the bank can, for structures that want it.
    """

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, noise_std: float,
        input_noise_std: float, drift_std: tuple[float, float, float], sample_period: float,
        observer: FixedBacklash | None = None,
    ) -> None:
        self.estimate = replace(initial, status=Status.ACQUIRING)
        self._adapting = True
        self.outliers = 0
        self._sample_period = sample_period
        self._settings = SearchSettings(
            model, bounds, initial, noise_std, input_noise_std, self._per_sample(drift_std),
            sample_period,
        )
        self._bounds = bounds
        self._observer, self._no_state = observer, np.zeros(model.order)
        self._inherited = initial if initial.learned else None
        self._search = self._new_search(self._inherited)
        self._challenger: _Watched | None = None
        self._known = initial.learned  # the estimate comes from data
        self._confirmed = 0  # samples since these data first gave an estimate
        self._in_vain = Status.ACQUIRING  # why the last first search ended without an estimate
        self._lost_in_a_row = 0

    @property
    def u_hat(self) -> float:
        """u that acted before the newest y, under the most likely gap; nan before any is known."""
        fine = self._search.search.fine
        return fine.u_hat() if fine is not None else nan

    @property
    def x_hat(self) -> NDArray[np.float64]:
        """State of G: from the bank while it may be trusted, otherwise from the first guess."""
        fine = self._trusted
        if fine is not None:
            return fine.mean[fine.leader, :self._settings.model.order]
        return self._observer.x_hat if self._observer is not None else self._no_state

    @property
    def x_cov(self) -> NDArray[np.float64] | None:
        """Covariance of x_hat; None while the bank cannot be trusted."""
        fine, n = self._trusted, self._settings.model.order
        return fine.cov[fine.leader, :n, :n] if fine is not None else None

    @property
    def _trusted(self) -> GapBank | None:
        # A bank that was there before the data has to find the state of G first.
        unsure = 2 * self._settings.model.order if self._inherited is not None else 0
        known = self._confirmed > unsure and not self._search.contradicted
        return self._search.search.fine if known else None

    @property
    def innovation(self) -> float:
        """y(k) minus its prediction; nan where y(k) was lost or nothing is known yet."""
        fine = self._search.search.fine
        return fine.innovation if fine is not None and self._lost_in_a_row == 0 else nan

    # Hypotheses that contradict the data may overflow before they are given up.
    @np.errstate(over='ignore', invalid='ignore')
    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        watched = self._search
        if self._observer is not None:
            self._observer.update(y, interval)
        if not watched.add(y, interval.v, self._adapting):
            self.outliers += 1
        if not self._adapting:
            self._challenger = None
        elif watched.failed_trial:
            self._challenge(y, interval.v)
            if self._search is watched:
                # The driver may not have heard v yet, which says nothing of the backlash.
                self._search, self._confirmed = self._new_search(self.estimate), 0
        elif watched.search.on_trial and self._challenger is not None:
            self._challenger.add(y, interval.v, adapting=True)
        elif not (self._confirmed or (self._known and watched.contradicted)):
            self._restart_in_vain(watched)
        elif watched.contradicted:
            self._challenge(y, interval.v)
        else:
            self._challenger = None
        self._publish()

    @property
    def adapting(self) -> bool:
        """Whether it learns; otherwise it goes on following the state of G alone."""
        return self._adapting

    @adapting.setter
    def adapting(self, adapting: bool) -> None:
        if adapting and not self._adapting:
            # The record has a hole now: it cannot be read again.
            if self._search.search.settled:
                self._search.search.forget_record()
            else:
                self._search = self._new_search(self.estimate if self._known else None)
        self._adapting = adapting

    def set_noise(
        self, noise_std: float, input_noise_std: float, drift_std: tuple[float, float, float],
    ) -> None:
        """Expect this noise from now on; whatever was learned stays."""
        self._settings = replace(
            self._settings, noise_std=noise_std, input_noise_std=input_noise_std,
            drift_std=self._per_sample(drift_std),
        )
        for watched in (self._search, self._challenger):
            if watched is not None:
                watched.search.set_noise(self._settings)

    def _per_sample(self, std: tuple[float, float, float]) -> tuple[float, float, float]:
        root = self._sample_period**0.5
        return std[0] * root, std[1] * root, std[2] * root

    @np.errstate(over='ignore', invalid='ignore')
    def refine(self, budget_s: float = inf) -> None:
        """Search on: read the record again, compare all gaps."""
        self._search.refine()
        if self._challenger is not None:
            self._challenger.refine()

    def _restart_in_vain(self, watched: _Watched) -> None:
        """Begin afresh where a first search found nothing, and remember why."""
        patience = RESTART_IN_VAIN if watched.contradicted else RESTART_AFTER
        if watched.inconsistent_for >= patience:
            self._in_vain = Status.INCONSISTENT
        elif watched.search.exhausted:
            self._in_vain = Status.NOT_EXCITED
        else:
            return
        self._search = self._new_search(self._inherited)

    def _new_search(self, inherited: Estimate | None = None) -> _Watched:
        return _Watched(GapSearch(self._settings, inherited))

    def _challenge(self, y: float | None, v: float) -> None:
        """Search afresh beside an estimate that the data contradict."""
        challenger = self._challenger
        if challenger is None or challenger.inconsistent_for >= RESTART_AFTER:
            challenger = self._challenger = self._new_search()
        challenger.add(y, v, adapting=True)
        if self._adoptable(challenger) is not None:
            self._search, self._challenger = challenger, None

    def _adoptable(self, watched: _Watched) -> Crossings | None:
        """The estimate of a search if it may replace another one.

        A rough estimate is better than none at the start, but not than one that held for long.
        """
        found = self._usable(watched) if watched.consistent_for >= PROVEN else None
        if found is None:
            return None
        precise = found.std_m < ADOPTED_SLOPE * found.m and watched.search.precise(
            found, ADOPTED_GAP
        )
        return found if precise or watched.consistent_for >= ADOPTED_AFTER else None

    def _usable(self, watched: _Watched) -> Crossings | None:
        """The estimate of a search if it is precise and within the bounds by its deviations."""
        found = watched.found
        if found is None or found.std_m > PRECISE_SLOPE * found.m:
            return None
        if not watched.search.precise(found, PRECISE_GAP) or watched.search.undecided:
            return None
        values = (found.m, found.c_r, found.c_l)
        slack = (found.std_m, found.std_c_r, found.std_c_l)
        inside = self._bounds.project(*values)
        outside = any(
            abs(a - b) > 3.0 * s + 1e-9 * abs(b)
            for a, b, s in zip(values, inside, slack, strict=True)
        )
        watched.outside_for = watched.outside_for + 1 if outside else 0
        return None if outside else found

    def _publish(self) -> None:
        status = self._status()
        # A first estimate may come out of an inconsistent start, a later one has to be consistent.
        frozen = status.frozen and (self._known or status != Status.INCONSISTENT)
        watched = self._search
        if frozen or not self._adapting:
            found = None
        elif self._known and not self._confirmed and not watched.search.inherits:
            found = self._adoptable(watched)  # it contradicts what was learned before
        else:
            found = self._usable(watched)
            if found is not None and not self._confirmed and watched.hesitates(found):
                found = None
        if found is None:
            if self.estimate.status != status:
                self.estimate = replace(self.estimate, status=status)
            return
        self._known = True
        self._confirmed += 1
        watched.proven = True  # whoever is relied upon may be contradicted
        if watched.search.on_trial:
            self.estimate = replace(self.estimate, status=Status.TRACKING)
            return
        m, c_r, c_l = self._bounds.project(found.m, found.c_r, found.c_l)
        self.estimate = Estimate(
            m, c_r, c_l, self.estimate.f, found.std_m, found.std_c_r, found.std_c_l,
            Status.TRACKING,
        )

    def _status(self) -> Status:
        watched = self._search
        if self._lost_in_a_row >= NO_DATA_AFTER:
            return Status.NO_DATA
        tried_again = watched.search.on_trial and self._challenger is not None
        if self._known and (watched.contradicted or tried_again):
            return Status.INCONSISTENT
        fine = watched.search.fine
        if fine is None:
            search = watched.search
            waited = search.samples >= UNDECIDED_AFTER and not search.excited
            return Status.NOT_EXCITED if waited else self._in_vain
        if fine.since_motion > self._settings.model.memory:
            return Status.NOT_EXCITED
        if watched.outside_for >= UNDECIDED_AFTER:
            return Status.INCONSISTENT
        return Status.TRACKING if self._confirmed else self._in_vain


class _Watched:
    """A search whose fine bank is gated, frozen and watched for contradictions."""

    def __init__(self, search: GapSearch) -> None:
        self.search = search
        self.consistent_for = 0  # samples
        self.inconsistent_for = 0  # samples
        self._hesitated = 0  # samples for which there was an estimate that was not used
        self.outside_for = 0  # samples for which a precise estimate lay outside the bounds
        self.contradicted = False
        self._waiting: tuple[float | None, float, bool] | None = None
        self.proven = search.inherits  # what was learned before is believed until contradicted
        self._refused = 0  # in a row
        self._calm: list[float] = []  # normalised innovations squared since a contradiction

    @property
    def found(self) -> Crossings | None:
        """Estimate of the leading hypothesis, None before there is a consistent one."""
        fine = self.search.fine
        if fine is None or not fine.active or fine.nis > NIS_TRUSTED:
            return None
        return fine.found()

    def hesitates(self, found: Crossings) -> bool:
        """Whether a first estimate had better wait, as it may be far off: not for ever."""
        search, fine = self.search, self.search.fine
        if self._hesitated >= LONGEST_DOUBT or search.negligible(found) or fine is None:
            return False
        self._hesitated += 1
        return search.doubted or fine.innovation**2 > GATE**2 * fine.innovation_var

    @property
    def failed_trial(self) -> bool:
        """Whether the data contradict what was learned before from the first sample on."""
        return self.search.on_trial and (self.contradicted or self.search.belied)

    def add(self, y: float | None, v: float, adapting: bool) -> bool:
        """Take in a sample; return False if y was refused as an outlier."""
        self._pass_on()
        search = self.search
        fine, accepted = search.fine, True
        if fine is not None:
            fine.predict(v)
            if y is not None:
                learn = adapting and not (
                    search.on_trial or self.contradicted or fine.since_motion > search.memory
                )
                accepted = fine.correct(y, GATE if self.proven else inf, learn)
                self._judge(fine, accepted)
            if search.settled and fine.turned and adapting:
                self._follow(fine)
        elif search.coarse is not None:
            self._count(search.coarse.nis < NIS_TRUSTED)
        if adapting:
            # A bank that is contradicted before it has settled must not blind the others.
            heard = accepted or (self.contradicted and not search.settled)
            self._waiting = (y, v, heard)
        return accepted

    def refine(self, budget_s: float = inf) -> None:
        """Let the search take in the newest sample and go on."""
        waiting, before = self._waiting, self.search.fine
        if waiting is None:
            return
        self._pass_on()
        if waiting[0] is None:
            return  # after lost samples v is late already
        self.search.search_on()
        fine = self.search.fine
        if fine is not None and fine is not before and fine.nis < NIS_TRUSTED:
            # What was held against the bank before says nothing of this one.
            self.contradicted, self.inconsistent_for, self._refused = False, 0, 0

    def _pass_on(self) -> None:
        """Let the search take in the newest sample, unless it has done so."""
        if self._waiting is not None:
            self.search.add(*self._waiting)
            self._waiting = None

    def _judge(self, fine: GapBank, accepted: bool) -> None:
        if not fine.active:
            return
        self._refused = 0 if accepted else self._refused + 1
        if self.contradicted:
            self._recover(fine, accepted)
        elif (
            self._refused >= REFUSED_IN_A_ROW or (self.proven and fine.nis > NIS_LIMIT)
            # An estimate that never was consistent with the data is not to be called so.
            or self.inconsistent_for >= RESTART_AFTER
        ):
            self.contradicted = True
            self._calm.clear()
        self._count(not self.contradicted and accepted and fine.nis < NIS_TRUSTED)
        if self.search.excited and self.consistent_for >= PROVEN:
            self.search.on_trial = False

    def _recover(self, fine: GapBank, accepted: bool) -> None:
        """End a contradiction when a run of samples fits again: the bad data are over."""
        if not accepted:
            self._calm.clear()
            return
        self._calm.append(fine.innovation**2 / fine.innovation_var)
        if len(self._calm) == PROVEN:
            if sum(self._calm) < NIS_TRUSTED * PROVEN:
                self.contradicted = False
                fine.forgive()
            self._calm.clear()

    def _count(self, consistent: bool) -> None:
        self.consistent_for = self.consistent_for + 1 if consistent else 0
        self.inconsistent_for = 0 if consistent else self.inconsistent_for + 1
        self.proven = self.proven or (
            self.search.fine is not None and self.consistent_for >= PROVEN
        )

    def _follow(self, fine: GapBank) -> None:
        """Let the hypotheses on the gap follow the estimate of it."""
        found = self.found
        if found is not None:
            fine.move_gaps(fine_gaps(found, len(fine.gaps)))
