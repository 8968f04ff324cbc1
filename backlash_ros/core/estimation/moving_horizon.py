"""The default law: a least-squares fit of the newest samples, with an error model of G.

Moving-horizon estimation (C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for
nonlinear discrete-time systems, IEEE Trans. Automatic Control 48 (2003) 246-258) of the gap, the
slope, the crossings, the error of G, the noise and the state of G at once. Samples are taken in
block by block; between the blocks only the play operator and an observer advance. All fits are made
in `refine`, in pieces, after the command. docs/estimation.md explains the method and measures it.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from math import inf, log, nan
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.backlash import clamp
from backlash_ros.core.estimation.attribution import Attribution, attributed
from backlash_ros.core.estimation.baselines.fixed import FixedBacklash
from backlash_ros.core.estimation.constants import (
    AS_GOOD,
    BEGINNING,
    BLOCK,
    BLOCK_SHARE,
    FIRST_SEARCH,
    GATE,
    GROWTH,
    LONGEST,
    MISFIT,
    MOVED,
    NO_DATA,
    NO_GAP,
    OUTLIERS,
    PRECISE_GAP,
    PRECISE_SLOPE,
    RECOVERED,
    REPLACING,
    REVERSALS,
    SEARCH_GROWTH,
    SEARCHED,
    SMALLEST_NOISE,
    UNDECIDED,
)
from backlash_ros.core.estimation.crossings import Crossings
from backlash_ros.core.estimation.error_model import build_error_model
from backlash_ros.core.estimation.observer import Observer
from backlash_ros.core.estimation.pace import Pace
from backlash_ros.core.estimation.protocol import Bounds, Estimate, Interval, Status
from backlash_ros.core.estimation.record import Record
from backlash_ros.core.estimation.relabelling import (
    Fitted,
    fitted,
    searched,
    with_better_model,
    with_walk,
)
from backlash_ros.core.estimation.window_fit import Around, Prior, Solution, Start, weights_of
from backlash_ros.core.state_model import StateModel

Array = NDArray[np.float64]
Task = Generator[None, None, None]

CAPACITY = 2 * LONGEST  # samples kept: those that are fitted, and those that come meanwhile
CHI2 = 16.27  # of three variables, exceeded once in 1,000 times
AT_REST = 3  # memories of G after which nothing moves any more
TOLD = 1.0  # scale of the error of G that was told
FEW = 0.2  # share of a block that may be outliers


class MovingHorizon:
    """Learns (m, c_r, c_l) and the error of G from y alone.

    initial: a first guess, or with its deviations what was learned before. model: G as told.
    uncertainty: relative spread of its time constants, damping and delay, 0 where it is exact.
    noise_std: of y, a first guess. walk_std: by which a disturbance of u walks within a record, a
    first guess. drift_std: random walk of m, c_r, c_l per square root of a
    second. observer: gives the state of G until the backlash is known, for structures that want it.
    """

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, noise_std: float,
        walk_std: float, drift_std: tuple[float, float, float], sample_period: float,
        uncertainty: float,
        observer: FixedBacklash | None = None,
    ) -> None:
        self.estimate = replace(initial, status=Status.ACQUIRING)
        self.model = model
        self.outliers = self.failed_fits = 0
        self.innovation = nan
        self._adapting = True
        self._pace = Pace()
        self._bounds = bounds
        self._drift = np.array(drift_std) * sample_period**0.5
        self._drifts = any(drift_std)
        self._around = Around(
            model, build_error_model(model, uncertainty), max(noise_std, SMALLEST_NOISE)
        )
        self._told, self._told_walk = self._around, walk_std
        self._before = observer
        self._observer: Observer | None = None
        self._attribution: Attribution | None = None  # of an observer
        self.reattributed = 0  # intervals over which another v acted than was said
        self._no_state = [0.0] * model.order
        self._known = initial.learned
        self._covariance: Array | None = None
        self._paused = False  # whether samples are left out, as nothing moves
        self._record = Record(CAPACITY)
        self._begin_acquisition(initial if initial.learned else None)
        # Of the play operator, once it is known.
        self._p = self._u = nan
        self._lost_in_a_row = 0
        self._refused: dict[int, float] = {}  # y of the newest samples, one after the other
        self._since_motion = 0
        self._v = nan
        self._reason = Status.ACQUIRING  # why there is no estimate
        self._contradicted_from: int | None = None  # sample from which the fit does not hold
        self._consistent = 0  # samples that do fit since then
        self._next_try = 0  # sample at which to try again

    def _begin_acquisition(self, inherited: Estimate | None) -> None:
        """Look for the backlash afresh; inherited: what is believed unless the samples deny it."""
        self._task: Task | None = None
        self._current: Fitted | None = None
        self._inherited = inherited
        self._candidate: Prior | None = None  # what the last search found
        self._rejected: Fitted | None = None  # the last fit of a search that gave no estimate
        self._search_at = self._record.end + FIRST_SEARCH
        self._refit_at = 0.0  # length of the record at which all of it is fitted anew
        self._moved_at = 0  # ... from which a gap that moved is reason to do so
        self._refitted = False  # whether it was fitted anew since it contradicts itself
        self._contradicted_from = None

    # --- what it tells -------------------------------------------------------------------------

    @property
    def u_hat(self) -> float:
        """u that acted before the newest y; nan before a backlash is known."""
        return self._u

    @property
    def x_hat(self) -> list[float]:
        """State of G in the coordinates of `model`, n values."""
        if self._observer is not None:
            return self._observer.state
        return self._before.x_hat.tolist() if self._before is not None else self._no_state

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None while no fit gives it."""
        return self._observer.cov if self._observer is not None else None

    @property
    def proposal(self) -> StateModel | None:
        """The G that was learned where it is another one than `model`."""
        around = self._around
        known = self._current is not None
        return around.model if known and around.model is not self.model else None

    @property
    def covariance(self) -> Array | None:
        """Covariance of (m, c_r, c_l) behind the published deviations, shape (3, 3)."""
        return self._covariance

    @property
    def noise_ratio(self) -> float:
        """Deviation of the noise as learned over the one that was told; nan before."""
        if self._current is None:
            return nan
        return self._current.solution.posterior.noise_std / self._around.told_std

    @property
    def unexplained(self) -> float:
        """Motion of u that no backlash and no G explains, over m times the gap.

        Where there is no estimate: of the last fit that gave none, nan before.
        """
        fitted = self._current or self._rejected
        return fitted.fit.unexplained(fitted.solution) if fitted is not None else nan

    @property
    def wrong_sign(self) -> bool:
        """Whether there is no estimate because y moves against v."""
        return self._rejected is not None and self._rejected.solution.m < 0.0

    @property
    def learned_model(self) -> StateModel:
        """The G behind the newest estimates, whether or not a structure has taken it up."""
        return self._around.model

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        """Relative deviation of the true response from that of `learned_model` at z (M,).

        Shape (M,); nan before anything is learned, 0 where G was told to be exact.
        """
        if self._current is None:
            return np.full(len(z), nan)
        return self._current.fit.response_std(self._current.solution, z)

    @property
    def waiting(self) -> int:
        """Samples of the record that no fit has taken in yet."""
        taken = self._current.fit.length if self._current is not None else 0
        return len(self._record) - taken

    @property
    def adapting(self) -> bool:
        """Whether it learns; otherwise it goes on following the state of G alone."""
        return self._adapting

    @adapting.setter
    def adapting(self, adapting: bool) -> None:
        if adapting and not self._adapting:
            self._restart_record()
        elif not adapting:
            self._task = None  # a fit that is under way would still move the estimate
        self._adapting = adapting

    def adopt(self, model: StateModel) -> None:
        """Give x_hat for this G from now on."""
        self.model = model
        self._no_state = [0.0] * model.order
        if self._current is not None:
            self._observer = None
            self._follow_state()
            return
        around = self._around
        self._around = around._replace(model=model, error=around.error.around(model))
        if self._before is not None:
            self._before = self._before.with_model(model)

    def set_noise(self, noise_std: float, walk_std: float, drift_std: Array) -> None:
        """Take another first guess of the noise and the walk; whatever was learned stays.

        drift_std: random walk of m, c_r, c_l per square root of a sample, shape (3,).
        """
        self._told_walk = walk_std
        self._around = self._around._replace(told_std=max(noise_std, SMALLEST_NOISE))
        self._drift, self._drifts = drift_std, bool(drift_std.any())

    # --- at every sample ------------------------------------------------------------------------

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        v, other = interval.v, interval.other
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        observer = self._observer
        accepted = y
        if observer is not None:
            estimate = self.estimate
            gap = estimate.c_r - estimate.c_l
            p = clamp(self._p, v, v + gap)
            self._since_motion = self._since_motion + 1 if p == self._p else 0
            attribution, there = self._attribution, p
            # An observer of a G that is known to be another one would blame the commands.
            if attribution is None and other == other and self._around.model is self.model:
                attribution = self._attribution = Attribution(observer)
            if attribution is not None:
                if other == other:
                    there = clamp(self._p, other, other + gap)
                attribution.note(estimate.m * (there - p))
            self._p = p
            self._u = u = estimate.m * (p - estimate.c_r)
            expected = observer.predict(u)
            if y is None:
                self.innovation = nan
            else:
                innovation = y - expected
                if attribution is not None:
                    explained, found = attribution.judge(innovation)
                    innovation -= explained
                    self.reattributed += len(found)
                    for ago in found:
                        if ago > 0:
                            self._record.exchange(self._record.end - ago)
                        else:
                            v, other = other, v
                            self._p, self._u = there, estimate.m * (there - estimate.c_r)
                self.innovation = innovation
                if innovation * innovation <= GATE**2 * observer.variance:
                    self._refused.clear()
                    observer.correct(innovation)
                elif len(self._refused) < OUTLIERS:
                    self._refused[self._record.end] = y
                    self.outliers += 1
                    accepted = None
                else:
                    # So many in a row were none: they are what the fit has to explain.
                    self._record.restore(self._refused)
                    observer.correct(innovation)
        else:
            self._since_motion = self._since_motion + 1 if v == self._v else 0
            if self._before is not None:
                self._before.update(y, interval)
        self._v = v
        if self._adapting:
            self._note(v, nan if accepted is None else accepted, other)
        self._set_status()

    def _note(self, v: float, y: float, other: float) -> None:
        memory = self.model.memory
        if self._observer is None and self._since_motion > AT_REST * memory:
            if not self._around.error.integrates:
                return  # all is at rest: the next motion goes on from here as if at once
        elif self._observer is not None and self._since_motion > memory:
            self._paused = True
            if self._current is not None and self._since_motion % BLOCK[1] == 0:
                # No fit says any more where the state is.
                self._observer.settle(self._current.solution.posterior.noise_std)
            return
        if self._paused or len(self._record) == CAPACITY:
            # The samples between are missing, or there was no time to take any in.
            self._paused = False
            self._restart_record()
        self._record.append(v, y, other)

    def _set_status(self) -> None:
        if self._lost_in_a_row >= NO_DATA:
            status = Status.NO_DATA
        elif self._observer is None:
            status = self._reason
        elif self._reason is Status.INCONSISTENT:
            status = Status.INCONSISTENT
        elif self._since_motion > self.model.memory:
            status = Status.NOT_EXCITED
        else:
            status = Status.TRACKING
        if status is not self.estimate.status:
            self.estimate = replace(self.estimate, status=status)

    # --- after the command -----------------------------------------------------------------------

    def refine(self, budget_s: float = inf) -> None:
        """Go on with the fit, in pieces, until nothing is left to do or the time is over."""
        timed = budget_s < inf
        begun = before = perf_counter() if timed else 0.0
        while True:
            if self._task is None:
                self._task = self._next_task()
                if self._task is None:
                    return
            try:
                with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
                    next(self._task)  # what is not finite is refused by the posterior
            except StopIteration:
                self._task = None
            except np.linalg.LinAlgError:
                # Samples that leave nothing but rounding: others may be better.
                self.failed_fits += 1
                self._record.forget_before(self._record.end)
                self._begin_acquisition(self.estimate if self._known else None)
                return
            if timed:
                now = perf_counter()
                self._pace.note(now - before, budget_s)
                # Another piece that takes as long must fit in as well.
                if 2.0 * now - before - begun > budget_s:
                    return
                before = now

    def _next_task(self) -> Task | None:
        if not self._adapting:
            return None
        record, current = self._record, self._current
        if current is None:
            return self._acquire() if record.end >= self._search_at else None
        length = current.fit.length
        waiting = len(record) - length
        fewest, most = BLOCK
        wanted = min(max(length // BLOCK_SHARE, fewest), most)
        if waiting >= (wanted if self._contradicted_from is None else fewest):
            return self._take_block()
        if self._contradicted_from is not None:
            return self._reconsider() if record.end >= self._next_try else None
        solution = current.solution
        if length >= self._refit_at:
            return self._refit()
        if abs(solution.gap - current.fit.start.gap) > MOVED * solution.std_gap \
                and length >= self._moved_at:
            return self._refit()
        aged = solution.correlation > 0.0 or self._drifts_more(solution, length)
        if aged and record.end >= self._next_try:
            if self._around.error.count and not self._refitted:
                # What contradicts may be a G that went astray: the plant has changed only where
                # the best fit of all says so.
                self._refitted = True
                return self._refit()
            self._refitted = False
            return self._halve()
        return None

    def _acquire(self) -> Task:
        """Look for the backlash in the newest samples."""
        record = self._record
        end = record.end
        self._search_at = end + max(int(len(record) * (SEARCH_GROWTH - 1.0)), BLOCK[0])
        first = max(record.first, end - SEARCHED)
        record.forget_before(first)
        v, y = record.since(first)
        around = self._around._replace(prior=None, most=inf, walk=self._told_walk)
        found = yield from searched(v, y, around, self._widest, self._pace)
        if self._inherited is not None:
            half = len(v) // 2
            for begin in (0, half):
                alone = found if begin == 0 else None
                kept = yield from self._confirmed(v[begin:], y[begin:], self._inherited, alone)
                if kept is not None:
                    self._install(*kept, first + begin)
                    return
            if found is None or self._usable(found[0], REPLACING) is None:
                self._reason = Status.INCONSISTENT
                return
        before, self._candidate = self._candidate, None
        if found is None or self._usable(found[0]) is None:
            self._explain(None if found is None else found[0])
            return
        # A first estimate has to be found twice: some samples alone may mislead.
        solution = found[0].solution
        self._candidate = Prior(solution.theta, solution.theta_cov)
        self._search_at = end + BLOCK[0]
        again = before is not None and not _contradicts(solution, before)
        wanted = REVERSALS if around.error.count else 1
        if again and found[0].decided and found[0].fit.reversals >= wanted:
            self._install(*found, first)

    def _confirmed(
        self, v: Array, y: Array, inherited: Estimate, free: tuple[Fitted, Around] | None,
    ) -> Generator[None, None, tuple[Fitted, Around] | None]:
        """A fit with what was learned before; None where the samples contradict it.

        free: a fit without it, if there is one.
        """
        prior = _prior_of(inherited)
        current = self._current
        # G is no worse known than it was: it does not explain whatever has happened.
        most = TOLD if current is None else current.solution.posterior.scale
        alone = self._around._replace(prior=None, most=most, walk=0.0)
        around = alone._replace(prior=prior)
        gap = inherited.c_r - inherited.c_l
        start = Start(gap, float(v[0]) + 0.5 * gap)
        kept = yield from fitted(v, y, around, start, inherited.m, self._pace)
        swing = float(np.ptp(v)) + gap
        # A gap wider than all of v: u never moves.
        still = yield from fitted(
            v, y, alone, Start(3.0 * swing, float(v[0]) + 1.5 * swing), inherited.m,
            self._pace,
        )
        least = still.solution.rms
        if free is not None:
            usable = self._usable(free[0], REPLACING) is not None
            if usable and _contradicts(free[0].solution, prior):
                return None
            least = min(least, free[0].solution.rms)
        solution = kept.solution
        good = solution.rms <= AS_GOOD * least and kept.fit.plausible(solution)
        same = not _beyond_chance(solution.theta - prior.theta, prior.cov)
        return (kept, around) if good and same else None

    def _take_block(self) -> Task:
        """Take in the samples that have come since the last block."""
        current = self._current
        assert current is not None
        fit, solution = current.fit, current.solution
        number = self._record.first + fit.length
        v, y = self._record.since(number)
        v, y = v[:4 * BLOCK[1]], y[:4 * BLOCK[1]]
        rows = fit.columns(v, y)
        squares, outliers = fit.contradiction(rows, y, solution)
        valid = np.isfinite(y)
        if np.count_nonzero(outliers) <= FEW * np.count_nonzero(valid):
            valid &= ~outliers
            self._record.lose(number + np.flatnonzero(outliers))
        misfit = float(squares[valid].mean()) if valid.any() else 0.0
        fits = misfit <= MISFIT
        fit.take(rows, np.where(valid & fits, y, nan), weights_of(y))
        yield
        self._judge(fits, number, len(v), number + _change(squares))
        solution = fit.solve()
        self._current = Fitted(fit, solution)
        if fits:
            self._publish()

    def _judge(self, fits: bool, number: int, count: int, change: int) -> None:
        """Note from when on the samples contradict the fit, or that they fit again.

        change: sample from which those that do not fit do not.
        """
        if fits:
            self._consistent += count
            since = self._contradicted_from
            if since is not None and self._consistent >= RECOVERED:
                # Whatever it was, it is over: what was measured meanwhile says nothing.
                self._record.lose(np.arange(since, number + count - self._consistent))
                self._contradicted_from = None
                self._reason = Status.TRACKING
            return
        self._consistent = 0
        if self._contradicted_from is None:
            self._contradicted_from = self._next_try = change

    def _refit(self) -> Task:
        """Fit the whole record anew; a long one loses its oldest third first."""
        current = self._current
        assert current is not None
        yield from self._attribute(current)
        record, around = self._record, self._around
        fit, solution = current.fit, current.solution
        start, first = fit.start, record.first
        if fit.length >= LONGEST:
            gone = LONGEST // 3
            first += gone
            v, y = record.since(record.first)
            start = fit.start_after(v[:gone])
            prior = None
            if around.error.count == 0 and solution.correlation == 0.0:
                part = yield from fitted(
                    v[:gone], y[:gone], around, fit.start, solution.m, self._pace
                )
                prior = self._drifted(part.solution, len(v) - gone)
            around = around._replace(prior=prior, most=around.most if prior else inf)
        elif around.error.count:
            # Where the play began costs as many unknowns as the error of G has.
            v, _ = record.since(first)
            unknown = start.forgotten_after(v)
            if unknown <= BEGINNING * len(v):
                first += unknown
                start = fit.start_after(v[:unknown])
        v, y = record.since(first)
        start = start.with_gap(solution.gap, v)
        if around.model is self._told.model:
            result, around = yield from self._fitted(v, y, around, start, solution.m)
        else:
            # A G that was moved step by step may have gone astray: what fits best from the one
            # that was told is as good a beginning.
            told = around._replace(
                model=self._told.model, error=self._told.error, scale=0.0
            )
            afresh = yield from self._fitted(v, y, told, start, solution.m)
            around = around._replace(scale=afresh[1].scale)
            result, around = yield from self._fitted(v, y, around, start, solution.m)
            if _evidence(afresh[0]) > _evidence(result):
                result, around = afresh
        result, around = yield from with_walk(v, y, around, result, self._pace)
        if len(v) <= SEARCHED and around.prior is None:
            # The gap of a short record may be one of several.
            other = yield from searched(v, y, self._around, self._widest, self._pace)
            if other is not None and self._usable(other[0]) is not None \
                    and _evidence(other[0]) > _evidence(result):
                result, around = other
        self._install(result, around, first)

    def _attribute(self, current: Fitted) -> Task:
        """Let those v have acted over the record that the estimates speak for."""
        record, found = self._record, current.solution.crossings
        others = record.others(record.first)
        if found is None or np.isnan(others).all():
            return
        # The observer begins at rest: what it expects says nothing yet.
        others[:self._around.model.memory] = nan
        v, y = record.since(record.first)
        observer = Observer(self._around.model, current.solution.posterior.noise_std)
        chosen = yield from attributed(
            v, y, others, (current.solution.start, found.gap), found.m, found.m * found.c_r,
            observer, self._pace.pieces(1),
        )
        record.attribute(record.first, chosen)

    def _fitted(
        self, v: Array, y: Array, around: Around, start: Start, slope: float,
    ) -> Generator[None, None, tuple[Fitted, Around]]:
        """The fit of a record, with the better G that follows from it."""
        result = yield from fitted(v, y, around, start, slope, self._pace)
        return (yield from with_better_model(v, y, around, result, self._pace))

    def _halve(self) -> Task:
        """Let the older half of the record go where the newer one contradicts the whole.

        Or where theta, as told, drifts by more than its deviation meanwhile.
        """
        current = self._current
        assert current is not None
        record = self._record
        fit, solution = current.fit, current.solution
        self._next_try = record.end + max(fit.length // 4, BLOCK[1])
        half = fit.length // 2
        if half < RECOVERED:
            return
        v, y = record.since(record.first)
        around = self._around._replace(prior=None, most=inf, walk=0.0)
        start = fit.start_after(v[:half]).with_gap(solution.gap, v[half:])
        newer = yield from fitted(v[half:], y[half:], around, start, solution.m, self._pace)
        whole = Prior(solution.theta, np.zeros((3, 3)))
        drifts = self._drifts_more(newer.solution, half)
        if self._usable(newer, REPLACING) is None \
                or not (_contradicts(newer.solution, whole) or drifts):
            return
        if self._drifts and not around.error.count:
            # What the older half says holds as far as theta has not drifted since.
            older = yield from fitted(
                v[:half], y[:half], self._around._replace(walk=0.0), fit.start, solution.m,
                self._pace,
            )
            prior = self._drifted(older.solution, half)
            if older.solution.m > 0.0 and not _contradicts(newer.solution, prior):
                around = around._replace(prior=prior)
                newer = yield from fitted(
                    v[half:], y[half:], around, newer.fit.start, solution.m, self._pace
                )
        self._install(newer, around, record.first + half)

    def _reconsider(self) -> Task:
        """Explain samples that contradict the fit: by all of them, or by a change of the plant."""
        current, since = self._current, self._contradicted_from
        assert current is not None
        assert since is not None
        record, around = self._record, self._around._replace(prior=None, most=inf, walk=0.0)
        bound = AS_GOOD * current.solution.posterior.noise_std
        end = record.end
        self._next_try = end + max(int((end - since) * (SEARCH_GROWTH - 1.0)), BLOCK[0])
        v, y = record.since(record.first)
        whole = yield from self._best_of_all(v, y, around)
        if whole is not None and whole[0].solution.rms <= bound \
                and whole[0].fit.misfit(whole[0].solution, since - record.first) <= MISFIT:
            self._install(*whole, record.first)
            return
        changes = []
        for first in (since, (since + end) // 2):
            first = max(first, end - SEARCHED)
            if end - first < RECOVERED:
                continue
            v, y = record.since(first)
            found = yield from searched(v, y, around, self._widest, self._pace)
            changes += [found[0]] if found is not None else []
            sharp = found is not None and self._usable(found[0], REPLACING)
            if found is not None and sharp and found[0].solution.rms <= bound \
                    and self._has_changed(found[0], whole):
                self._install(*found, first)
                return
            # The same backlash, but something has moved the plant meanwhile.
            kept = yield from self._confirmed(v, y, self.estimate, found)
            if kept is not None and kept[0].solution.rms <= bound \
                    and self._has_changed(kept[0], whole):
                self._install(*kept, first)
                return
        if whole is not None and changes and not any(
            self._has_changed(change, whole) for change in changes
        ):
            self._install(*whole, record.first)
            return
        if end - since >= RECOVERED:
            self._reason = Status.INCONSISTENT
        if end - since > SEARCHED:
            self._begin_acquisition(self.estimate)

    def _best_of_all(
        self, v: Array, y: Array, around: Around,
    ) -> Generator[None, None, tuple[Fitted, Around] | None]:
        """The most likely usable fit of a record by one plant."""
        current = self._current
        assert current is not None
        found = []
        for beginning in self._beginnings(around):
            if len(v) <= SEARCHED:
                result = yield from searched(v, y, beginning, self._widest, self._pace)
            else:
                start = current.fit.start.with_gap(current.solution.gap, v)
                result = yield from self._fitted(v, y, beginning, start, current.solution.m)
            if result is not None and self._usable(result[0]):
                found.append(result)
        return max(found, key=lambda result: _evidence(result[0]), default=None)

    def _beginnings(self, around: Around) -> list[Around]:
        """This one, and that of the G that was told where it is another one.

        A G that was moved step by step may have gone astray.
        """
        told = self._told
        if around.model is told.model:
            return [around]
        return [around, around._replace(model=told.model, error=told.error, scale=0.0)]

    def _has_changed(self, newer: Fitted, whole: tuple[Fitted, Around] | None) -> bool:
        """Whether two plants, the present fit and one of the newer samples, are more likely.

        Than one for the whole record. Every unknown of the newer one costs half the logarithm of
        its samples (G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978)
        461-464).
        """
        current = self._current
        assert current is not None
        if whole is None:
            return True
        fit = newer.fit
        unknowns = fit.layout.driven + fit.around.error.count
        told = fit.around.told_std / newer.solution.posterior.noise_std
        both = _evidence(current) + _evidence(newer) + log(told)
        return both - 0.5 * unknowns * log(fit.length) > _evidence(whole[0])

    # --- what comes out --------------------------------------------------------------------------

    @property
    def _widest(self) -> float:
        return self._bounds.c_r[1] - self._bounds.c_l[0]

    def _install(self, result: Fitted, around: Around, first: int) -> None:
        """Go on from this fit of the record from sample `first` on."""
        self._current, self._around = result, around
        self._record.forget_before(first)
        self._refit_at = min(GROWTH * result.fit.length, LONGEST)
        if result.fit.length >= LONGEST:
            self._refit_at = LONGEST
        self._moved_at = result.fit.length + BLOCK[1]
        self._contradicted_from = self._rejected = None
        self._reason = Status.TRACKING
        self._publish()

    def _usable(self, result: Fitted, share: float = 1.0) -> Crossings | None:
        """The crossings of a fit if they are precise and within the bounds by their deviations.

        share: of the usual deviations that is allowed.
        """
        solution = result.solution
        found = solution.crossings
        if found is None or not found.std_m <= share * PRECISE_SLOPE * found.m:
            return None
        if not found.std_gap <= share * max(PRECISE_GAP * found.gap, NO_GAP * result.fit.swing):
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
        assert self._current is not None
        found = self._usable(self._current)
        if found is not None and self._too_early(self._current, found):
            found = None
        if found is None:
            self._reason = Status.INCONSISTENT
            if self._observer is None:
                return
        else:
            if self._contradicted_from is None:
                self._reason = Status.TRACKING
            m, c_r, c_l = self._bounds.project(found.m, found.c_r, found.c_l)
            self._known = True
            self._covariance = found.cov
            self.estimate = Estimate(
                m, c_r, c_l, self.estimate.f, found.std_m, found.std_c_r, found.std_c_l,
                self.estimate.status,
            )
        self._follow_state()

    def _too_early(self, result: Fitted, found: Crossings) -> bool:
        """Whether a short record, begun after a change of the plant, is still worse than nothing.

        A rough estimate is better than none, but not than one that held.
        """
        if result.fit.length >= UNDECIDED or self._covariance is None:
            return False
        wider = np.any(np.diag(found.cov) > np.diag(self._covariance))
        return bool(wider) and self._usable(result, REPLACING) is None

    def _follow_state(self) -> None:
        """Let play operator and observer stand where the fit says that the plant stands."""
        current = self._current
        assert current is not None
        fit, solution = current.fit, current.solution
        estimate = self.estimate
        gap = estimate.c_r - estimate.c_l
        v = self._record.since(self._record.first + fit.length)[0]
        p = fit.play_output(gap, solution)
        observer = self._observer
        exact, cov = None, None
        if self._around.model is self.model:
            exact, cov = fit.state(solution)
        else:
            self._attribution = None
        noise = solution.posterior.noise_std
        if observer is None:
            observer = self._observer = Observer(self.model, noise)
            self._attribution = None
            if exact is None:
                exact, cov = self._replayed(), None
        else:
            observer.settle(noise)
            if exact is None or cov is None or np.trace(cov) > np.trace(observer.noise_cov):
                exact = None
        for value in v.tolist():
            p = clamp(p, value, value + gap)
        self._p, self._u = p, estimate.m * (p - estimate.c_r)
        if exact is not None:
            start = fit.play_output(gap, solution)
            observer.start(exact, cov)
            for value in v.tolist():
                start = clamp(start, value, value + gap)
                observer.predict(estimate.m * (start - estimate.c_r))

    def _replayed(self) -> Array:
        """State of a G that is not the one of the fit, from the samples of the fit."""
        current = self._current
        assert current is not None
        fit, solution = current.fit, current.solution
        v, y = self._record.since(self._record.first)
        v, y = v[:fit.length], y[:fit.length]
        u = fit.input(solution, v)
        observer = Observer(self.model, solution.posterior.noise_std)
        for value, measured in zip(u.tolist(), y.tolist(), strict=True):
            expected = observer.predict(value)
            if measured == measured:
                observer.correct(measured - expected)
        return np.array(observer.state)

    def _explain(self, result: Fitted | None) -> None:
        """Say why there is no estimate, where the samples should suffice for one."""
        if self._record.end < UNDECIDED:
            return
        self._rejected = result
        if result is None:
            self._reason = Status.NOT_EXCITED
            return
        solution = result.solution
        wrong_sign = solution.m < 0.0
        if wrong_sign or solution.count * solution.correlation > 1.0:
            self._reason = Status.INCONSISTENT
        else:
            self._reason = Status.ACQUIRING

    def _drifts_more(self, solution: Solution, samples: int) -> bool:
        """Whether drift over so many samples is more than the noise leaves unknown."""
        found = solution.crossings
        if found is None or not self._drifts or samples < BLOCK[1]:
            return False
        return bool(np.any(self._drift**2 * (samples / 3.0) > np.diag(found.cov)))

    def _drifted(self, solution: Solution, samples: int) -> Prior:
        """What a solution says of theta after so many samples of drift."""
        m, product_r, product_l = solution.theta.tolist()
        jacobian = np.array([[1.0, 0.0, 0.0], [product_r / m, m, 0.0], [product_l / m, 0.0, m]])
        drift = jacobian @ np.diag(self._drift**2 * samples) @ jacobian.T
        return Prior(solution.theta, solution.theta_cov + drift)

    def _restart_record(self) -> None:
        """Begin a new record with what the old one says as a prior."""
        self._task = None
        current, record = self._current, self._record
        record.forget_before(record.end)
        if current is None:
            self._begin_acquisition(self._inherited)
            return
        solution = current.solution
        self._around = self._around._replace(prior=Prior(solution.theta, solution.theta_cov))
        estimate = self.estimate
        gap = estimate.c_r - estimate.c_l
        fit = current.fit.restarted(self._around, Start(gap, self._p))
        self._current = Fitted(fit, fit.solve())
        self._refit_at = GROWTH * BLOCK[1]
        self._contradicted_from = None


def _prior_of(estimate: Estimate) -> Prior:
    m, c_r, c_l = estimate.m, estimate.c_r, estimate.c_l
    jacobian = np.array([[1.0, 0.0, 0.0], [c_r, m, 0.0], [c_l, 0.0, m]])
    std = np.array([estimate.std_m, estimate.std_c_r, estimate.std_c_l])
    std = np.maximum(std, 1e-9 * np.array([m, c_r - c_l, c_r - c_l]))
    return Prior(np.array([m, m * c_r, m * c_l]), jacobian @ np.diag(std**2) @ jacobian.T)


def _evidence(result: Fitted) -> float:
    return result.solution.posterior.evidence


def _change(squares: Array) -> int:
    """Where samples begin to contradict a fit, from the normalised squares of residuals (N,).

    The likeliest sample of a change after which their mean is beyond MISFIT (cumulative sum test:
    E. S. Page, Continuous inspection schemes, Biometrika 41 (1954) 100-115).
    """
    excess = np.where(np.isfinite(squares), squares - MISFIT, 0.0)
    return int(np.argmax(np.cumsum(excess[::-1])[::-1]))


def _contradicts(solution: Solution, other: Prior) -> bool:
    """Whether two estimates of theta differ by more than chance."""
    return _beyond_chance(solution.theta - other.theta, solution.theta_cov + other.cov)


def _beyond_chance(difference: Array, cov: Array) -> bool:
    """Whether a difference (3,) of this covariance (3, 3) is one in 1,000 or rarer."""
    return float(difference @ np.linalg.solve(cov, difference)) > CHI2
