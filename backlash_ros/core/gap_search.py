"""Global search for the gap width: fits or a coarse grid find the basin, replays refine it.

While the record is short it is fitted as a whole (early_fits.py): a fit names the gaps of a fine
bank, and where in them u was at the start. Where fits fail the coarse bank names them. It covers
every gap the bounds allow, and its winner a narrow range around its own estimate of c_r - c_l.
Either way the fine bank is run over the recorded samples from the first one on, several at a time,
until it has caught up and takes over. As the estimate sharpens, this is repeated: samples that an
earlier, wrong gap had put on the wrong side are read afresh, so that noise-free data lead to the
exact parameters and not to a residue of the grid.
"""

from __future__ import annotations

from math import hypot, inf, isnan, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.bank_making import BankMaker, SearchSettings
from backlash_ros.core.early_fits import EarlyFits
from backlash_ros.core.estimation.crossings import Crossings
from backlash_ros.core.estimation.protocol import Estimate
from backlash_ros.core.gap_bank import GapBank
from backlash_ros.core.gap_choice import FINE, beyond, bracket, coarse_gaps, fine_gaps

Array = NDArray[np.float64]

NARROW = 0.04  # width of a fine bank, as a share of the gap, that needs no better decision
LOST = 3.0  # standard deviations between read and estimated gap from which both are tried
CAPACITY = 16384  # samples kept for replays
REPLAY_SPEED = 5  # recorded samples per new one
# While no estimate is known, or none that may be used: as many as this share of the time allows,
# a bank taking some time for each.
FIRST_REPLAY_SHARE, BANK_STEP_S = 0.3, 60e-6
SLOWEST_FIRST, FASTEST_FIRST = 8, 50
LAST_REPLAY = CAPACITY * (REPLAY_SPEED - 1) // REPLAY_SPEED  # later ones would not catch up
GROWTH_EARLY, GROWTH_LATE = 1.3, 4.0  # of the record between two replays
EARLY = 400  # samples during which a misread record still shows in the estimate
# Standard deviations between the gap a record was read with and its estimate that are too many.
MISREAD_EARLY, MISREAD_LATE = 0.5, 2.0
TINY_GAP = 0.02  # of the swing of v: fits do not look below
# Standard deviations of the gap between two gaps of a fine bank: fewer call for a new fit, and with
# even fewer the bank is of no use.
COARSE, COARSEST = 0.7, 0.4
PAUSE = 5  # samples between two looks for a reason to read the record again
START_GATE = 8.0  # standard deviations; before the fine bank stands only gross outliers are told
PATIENCE = 2  # outliers in a row that the coarse bank refuses before it believes them
NULL_MARGIN = 15.0  # log-likelihood by which a gap must beat "v never engaged"
COARSE_MARGIN = 10.0  # log-likelihood by which the fine bank may not fall behind the coarse one
DOUBT_MARGIN = 3.0  # the same for an estimate that may be used; a refined one is ahead by some 5
REPLAY_PRECISION = 0.5  # of the gap: known better, it is worth a fine bank
NO_GAP = 0.01  # of the swing of v: a gap known this well may be 0
REPLAY_MARGIN = 5.0  # log-likelihood by which a bank that read the record afresh may be worse
SETTLED = 100  # samples of the fine bank after which the coarse one may rest
NIS_SETTLED = 1.6  # normalised innovation squared of a fine bank that may be trusted to go alone
# Share of the widest gap within which v counts as at rest at the start. A trajectory with preview
# begins with moves that are nothing but rounding, and say nothing of the scale of things.
AT_REST = 1e-6
# Share of the slope and of the gap that may have changed while nobody looked.
CHANGED_MEANWHILE = 0.01


class GapSearch:
    """Finds and refines the gap from (y, v), sample by sample."""

    def __init__(self, settings: SearchSettings, inherited: Estimate | None = None) -> None:
        """inherited: what was learned before; it is believed until the data contradict it."""
        self.fine: GapBank | None = None
        self.coarse: GapBank | None = None
        self.samples = 0
        # What was learned before is neither improved nor replaced until the data agree with it.
        self.on_trial = inherited is not None
        self._maker = BankMaker(settings)
        self._widest = settings.bounds.c_r[1] - settings.bounds.c_l[0]
        self._inherited = None if inherited is None else _aged(inherited)
        self._y, self._v = np.empty(CAPACITY), np.empty(CAPACITY)
        self._fits = EarlyFits(
            settings.model.transfer_function, self._widest, settings.sample_period
        )
        self._replay: GapBank | None = None
        self._replayed = 0
        self._read_with: Array = np.empty(0)  # gaps with which the fine bank read the record
        self._fine_since = 0
        self._behind_by = -inf  # log-likelihood by which the coarse bank leads over the fine one
        self._earliest = 0
        affordable = int(FIRST_REPLAY_SHARE * settings.sample_period / BANK_STEP_S)
        self._first_speed = min(max(affordable, SLOWEST_FIRST), FASTEST_FIRST)
        self._next_fit = 0  # sample
        self._refused = 0
        self._settled = False

    @property
    def memory(self) -> int:
        """Samples after which the plant has forgotten its input."""
        return self._maker.settings.model.memory

    @property
    def settled(self) -> bool:
        """Whether the fine bank has proven to be as good as the coarse one, which then rests."""
        return self._settled

    @property
    def inherits(self) -> bool:
        """Whether it still believes what was learned before."""
        return self._inherited is not None

    @property
    def exhausted(self) -> bool:
        """Whether the record is used up without a sign of engagement: begin afresh."""
        return self.samples >= LAST_REPLAY and self.fine is None and not self.excited

    def precise(self, found: Crossings, share: float) -> bool:
        """Whether the gap is known to a share of itself, or well enough for this v."""
        return found.std_gap < share * found.gap or self.negligible(found)

    def negligible(self, found: Crossings) -> bool:
        """Whether what is not known of the gap is as good as nothing against the swing of v."""
        return self.coarse is not None and found.std_gap < NO_GAP * self.coarse.swing

    @property
    def excited(self) -> bool:
        """Whether the data show that v has engaged at all."""
        coarse = self.coarse
        if coarse is None or coarse.leader == 0:
            return False
        likelihood = coarse.log_likelihood
        return bool(likelihood[coarse.leader] - likelihood[0] > NULL_MARGIN)

    @property
    def undecided(self) -> bool:
        """Whether the gap may well be none of those that the fine bank tells apart.

        Then its first or its last hypothesis is the most likely one: it fits the newest samples
        with crossings that are wrong, and is sure of them.
        """
        return self.fine is not None and not self._settled and self._is_undecided(self.fine)

    def _is_undecided(self, bank: GapBank) -> bool:
        if 0 < bank.leader < bank.active - 1:
            return False
        found = bank.found()
        if found is not None and self.negligible(found):
            return False
        return bool(bank.gaps[-1] - bank.gaps[0] > NARROW * bank.gaps[-1])

    @property
    def doubted(self) -> bool:
        """Whether other gaps explain the data about as well as the fine bank, or better."""
        return self._behind_by > DOUBT_MARGIN and not self._settled

    @property
    def belied(self) -> bool:
        """Whether some other gap explains the data better than what was learned before."""
        return self.on_trial and self._behind_by > COARSE_MARGIN

    def forget_record(self) -> None:
        """Go on with what the banks know; nothing is read again."""
        self.samples, self._replay = max(self.samples, CAPACITY), None
        self._fits.give_up()

    def add(self, y: float | None, v: float, accepted: bool = True) -> None:
        """Take in a sample; y is None if it was lost, not accepted if it is an outlier."""
        value = nan if y is None or not accepted else y
        if self.coarse is None and self.samples and abs(v - self._v[0]) <= AT_REST * self._widest:
            self.samples, v = 0, float(self._v[0])  # at rest nothing is worth a record
        if self.samples < CAPACITY:
            self._y[self.samples], self._v[self.samples] = value, v
        self.samples += 1
        if self.coarse is None:
            self._begin()
        else:
            self._step_coarse(value, v)
        if self.samples > CAPACITY:
            self._replay = None  # it was put off for too long: there is nothing left to read

    def search_on(self) -> None:
        """Read some more of the record again, or look for a reason to; this may wait."""
        if self._replay is not None:
            self._advance_replay()
        elif self._fits.running:
            self._advance_fit()
        elif not self.on_trial:
            self._plan_replay()

    def _begin(self) -> None:
        """Start the coarse bank with the first motion of v, which gives the scale of things."""
        count = self.samples
        if np.ptp(self._v[:count]) == 0.0:
            return
        self._maker.see_motion(float(np.abs(self._v[:count]).max()))
        banks = [self._maker.coarse(coarse_gaps(self._widest))]
        self.coarse = banks[0]
        if self._inherited is not None:
            self._read_with = fine_gaps(self._inherited, FINE)
            self.fine = self._maker.fine(self._read_with, self._inherited, self._inherited)
            self._fine_since = count
            banks.append(self.fine)
        for y, v in zip(self._y[:count], self._v[:count], strict=True):
            for bank in banks:
                _advance(bank, y, v)

    def _step_coarse(self, y: float, v: float) -> None:
        coarse = self.coarse
        assert coarse is not None
        if self._settled:
            return
        coarse.predict(v)
        if isnan(y):
            return
        if coarse.correct(y, START_GATE if self.fine is None else inf):
            self._refused = 0
        elif self._refused < PATIENCE:
            self._refused += 1
            if self.samples <= CAPACITY:
                self._y[self.samples - 1] = nan
        else:
            coarse.correct(y)
        fine = self.fine
        if fine is not None and not self._behind(fine) and fine.nis < NIS_SETTLED:
            self._settled = self.samples - self._fine_since > SETTLED

    def _behind(self, fine: GapBank) -> bool:
        """Whether the coarse bank explains the data better than this one."""
        coarse = self.coarse
        if self._settled or coarse is None or not fine.active:
            return False
        by = coarse.elect() - fine.elect()
        if fine is self.fine:
            self._behind_by = by
        return by > COARSE_MARGIN

    def _plan_replay(self) -> None:
        """Start a fine bank around the best estimate there is, when it is worth it."""
        if self._may_fit:
            self._plan_fit()
            return
        due = self.samples >= self._earliest
        if not (due or (self.undecided and self.samples % PAUSE == 0)) or not self.excited:
            return
        if self.fine is not None and self.samples >= LAST_REPLAY:
            return
        bank, read_with = self.fine, self._read_with
        if bank is not None and not bank.active:
            return
        if bank is None or self._behind(bank):
            bank = self.coarse
            assert bank is not None
            read_with = bank.gaps
            self._inherited = None
        bank.elect()
        best = bank.leader
        if due:
            self._earliest = self.samples + PAUSE
        found = bank.found()
        if found is None or not self.precise(found, REPLAY_PRECISION):
            return
        if self.samples >= LAST_REPLAY:
            # Too late to read the record again: go on with what the coarse bank knows.
            self._fine_since = self.samples
            self.fine = bank.part(max(best - 1, 1), min(best + 2, bank.active))
            return
        early = self.samples < EARLY
        limit = MISREAD_EARLY if early else MISREAD_LATE
        if bank is self.fine and abs(found.gap - read_with[best]) <= limit * found.std_gap:
            return
        growth = GROWTH_EARLY if early else GROWTH_LATE
        self._earliest = int(growth * self.samples)
        gaps = fine_gaps(found, FINE)
        if bank is self.fine and self.undecided:
            gaps = np.union1d(gaps, beyond(read_with, best))
        elif abs(found.gap - read_with[best]) > LOST * found.std_gap:
            gaps = np.union1d(gaps, bracket(read_with, best))
        self._replay, self._replayed = self._maker.fine(gaps, found, self._inherited), 0

    @property
    def _may_fit(self) -> bool:
        """Whether the record as a whole may still be fitted."""
        s = self._maker.settings
        supposed = s.noise_std > self._maker.noise_floor and s.input_noise_std == 0.0
        # What was inherited counts more than a short record.
        if self.inherits or any(s.drift_std) or not supposed:
            return False
        if not self._fits.possible(self.samples):
            return False
        return self._fits.successful or not self._has_tiny_gap()

    def _has_tiny_gap(self) -> bool:
        """Whether the gap is too small for a fit, which tells gaps apart in terms of themselves."""
        bank, coarse = self.fine or self.coarse, self.coarse
        if bank is None or coarse is None or not bank.active:
            return False
        found = bank.found()
        if found is None or found.gap >= TINY_GAP * coarse.swing:
            return False
        return self.negligible(found)

    def _plan_fit(self) -> None:
        """Begin a fit of all samples so far, unless the record was read with the right gaps."""
        fine, count = self.fine, self.samples
        # After an outlier it has to be seen first whether more follow.
        if count < self._next_fit or isnan(self._y[count - 1]) or not self.excited:
            return
        if fine is None or not self._well_read(fine):
            self._next_fit = count + (1 if fine is None else PAUSE)
            self._fits.begin(self._y[:count], self._v[:count], self._maker.settings.noise_std)

    def _well_read(self, fine: GapBank) -> bool:
        found = fine.found()
        if found is None or (fine.nis > NIS_SETTLED and not self._settled):
            return False
        misread = abs(found.gap - self._read_with[fine.leader]) > MISREAD_EARLY * found.std_gap
        return not misread and _resolve(self._read_with, fine.leader, found, COARSE)

    def _advance_fit(self) -> None:
        best = self._fits.advance(self.samples)
        if best is not None:
            self._earliest = int(GROWTH_EARLY * self.samples)
            y, v = self._y[:self.samples], self._v[:self.samples]
            self._replay, self._replayed = self._maker.fitted(best, y, v), 0

    def _advance_replay(self) -> None:
        replay = self._replay
        assert replay is not None
        hurry = self.fine is None or self.undecided
        speed = self._first_speed if hurry or replay.begins_at_once else REPLAY_SPEED
        end = min(self._replayed + speed, self.samples)
        for k in range(self._replayed, end):
            _advance(replay, float(self._y[k]), float(self._v[k]))
        self._replayed = end
        if end < self.samples:
            return
        self._replay = None
        if not replay.active:
            return  # gaps that v has not even swung over yet
        if replay.begins_at_once and not self._holds(replay):
            return
        fine = self.fine
        refuted = self._behind(replay)
        if refuted:
            self._earliest = self.samples  # while it was read: no reason to wait
        if fine is None or (self._behind(fine) and not refuted):
            self._fine_since = self.samples
        elif not replay.begins_at_once and self._is_no_gain(replay, fine):
            return
        self.fine, self._read_with = replay, replay.gaps
        self._behind(replay)

    def _holds(self, replay: GapBank) -> bool:
        """Whether a bank from a fit still is right: what has come since may tell much more."""
        replay.elect()
        found = replay.found()
        if found is None or replay.nis > NIS_SETTLED:
            return False
        return _resolve(replay.gaps, replay.leader, found, COARSEST)

    def _is_no_gain(self, replay: GapBank, fine: GapBank) -> bool:
        """Whether a replay would only raise doubts, or explains the record worse."""
        if self._is_undecided(replay) and not self._is_undecided(fine):
            return True
        return self._worse(replay, fine) or fine.nis < NIS_SETTLED < replay.nis

    def _worse(self, replay: GapBank, fine: GapBank) -> bool:
        """Whether a bank that read the record afresh explains it worse than the present one."""
        by, i = fine.elect() - replay.elect(), fine.leader
        inside = 0 < i < fine.active - 1
        # Between two hypotheses a likely gap may look unlikely: one far from it has to be better.
        if inside and not fine.gaps[i - 1] <= replay.gaps[replay.leader] <= fine.gaps[i + 1]:
            return by > -COARSE_MARGIN
        return by > REPLAY_MARGIN

    def set_noise(self, settings: SearchSettings) -> None:
        """Expect the noise of these settings from now on; whatever was learned stays."""
        self._maker.settings = settings
        for bank in (self.coarse, self.fine, self._replay):
            if bank is not None:
                bank.set_noise(self._maker.noise(bank.found() or settings.initial))


def _aged(estimate: Estimate) -> Crossings:
    """An estimate from before, with the deviations that it may be trusted for today."""
    least = CHANGED_MEANWHILE * (estimate.c_r - estimate.c_l)
    std_c_r, std_c_l = max(estimate.std_c_r, least), max(estimate.std_c_l, least)
    return Crossings(
        estimate.m, estimate.c_r, estimate.c_l,
        max(estimate.std_m, CHANGED_MEANWHILE * estimate.m), std_c_r, std_c_l,
        hypot(std_c_r, std_c_l),
    )


def _advance(bank: GapBank, y: float, v: float) -> None:
    bank.predict(v)
    if not isnan(y):
        bank.correct(y)


def _resolve(gaps: Array, leader: int, found: Crossings, least: float) -> bool:
    """Whether the leader has neighbours, no more than 1 / least deviations of the gap away."""
    if not 0 < leader < len(gaps) - 1:
        return False
    return bool(found.std_gap > least * (gaps[leader + 1] - gaps[leader]))
