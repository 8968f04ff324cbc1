"""The default law: a least-squares fit of the newest samples, with an error model of G.

Moving-horizon estimation (C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for
nonlinear discrete-time systems, IEEE Trans. Automatic Control 48 (2003) 246-258) of the gap, the
slope, the crossings, the error of G, the noise and the state of G at once. `update` records a
sample and lets the play operator and an observer advance (state_following.py). All fits are made
in `refine`, in pieces, after the command: schedule.py says which is due, learning.py what they
share. docs/estimation.md explains the method and measures it.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot, inf, nan
from time import perf_counter, thread_time

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.estimation.constants import (
    BLOCK,
    NO_DATA,
)
from backlash_ros.core.estimation.fit.crossings import Crossings
from backlash_ros.core.estimation.fit.learned_error import response_std
from backlash_ros.core.estimation.fit.solution import SMALLEST_NOISE, Around
from backlash_ros.core.estimation.moving_horizon.belief import (
    Belief,
    believable,
    denied_by_samples,
    judged,
    load_coasts,
)
from backlash_ros.core.estimation.moving_horizon.learning import CAPACITY, Learning, Task
from backlash_ros.core.estimation.moving_horizon.schedule import next_task
from backlash_ros.core.estimation.observer.state_following import Sample, StateFollowing
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.law import Interval, Law, LawReport
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

AT_REST = 3  # memories of G after which nothing moves any more


class MovingHorizon(Law):
    """Learns (m, c_r, c_l) and the error of G from y alone.

    initial: a first guess, or with its deviations what was learned before. model: G as told.
    uncertainty: relative spread of its time constants, damping and delay, 0 where it is exact.
    noise_std: of y, a first guess. walk_std: by which a disturbance of u walks within a record, a
    first guess. drift_std: random walk of m, c_r, c_l per square root of a second. observer: gives
    the state of G until the backlash is known, for structures that want it.
    """

    RETUNED = (
        'estimator.output_noise_std', 'estimator.input_noise_std', 'estimator.drift_std',
    )

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, noise_std: float,
        walk_std: float, drift_std: tuple[float, float, float], sample_period: float,
        uncertainty: float, observer: FixedBacklash | None = None,
    ) -> None:
        self.estimate = replace(initial, status=Status.ACQUIRING)
        self._failed_fits = 0
        error = build_error_model(model, uncertainty)
        told = Around(
            error, max(noise_std, SMALLEST_NOISE),
            inherited=initial.learned and error.count > 0,
        )
        self._learning = Learning(
            bounds, told, walk_std, np.array(drift_std) * sample_period**0.5, told
        )
        self._learning.begin_acquisition(initial if initial.learned else None)
        self._following = StateFollowing(model, observer)
        self._task: Task | None = None
        self._idle_until = 0  # number of the sample before which no task is due
        self._adapting = True
        self._paused = False  # whether samples are left out, as nothing moves
        self._coasts = False
        self._stds = initial.std_c_r, initial.std_c_l  # of the crossings, while nothing coasts
        self._lost_in_a_row = 0

    # --- what it tells -------------------------------------------------------------------------

    @property
    def model(self) -> StateModel:
        """The G that x_hat is the state of."""
        return self._following.model

    @property
    def covariance(self) -> Array | None:
        """Covariance of (m, c_r, c_l) behind the published deviations, shape (3, 3)."""
        return self._learning.held

    @property
    def u_hat(self) -> float:
        """u that acted before the newest y; nan before a backlash is known."""
        return self._following.u

    @property
    def x_hat(self) -> list[float]:
        """State of G in the coordinates of `model`, n values."""
        return self._following.x_hat

    @property
    def x_cov(self) -> Array | None:
        """Covariance of x_hat, shape (n, n); None while no fit gives it."""
        return self._following.x_cov

    @property
    def innovation(self) -> float:
        """y minus what was expected; nan where it was lost, and before a backlash is known."""
        return self._following.innovation

    @property
    def report(self) -> LawReport:
        """How its work goes."""
        learning, following = self._learning, self._following
        current, rejected = learning.current, learning.acquisition.rejected
        return LawReport(
            noise_ratio=nan if current is None
            else current.solution.posterior.noise_std / learning.around.told_std,
            unexplained=self._unexplained, coasts=self._coasts,
            unconfirmed=current is not None and not learning.confirmed,
            wrong_sign=rejected is not None and rejected.solution.m < 0.0,
            waiting=learning.waiting,
            outliers=following.outliers + learning.outliers,
            reattributed=following.reattributed + learning.reattributed,
            failed_fits=self._failed_fits,
        )

    @property
    def proposal(self) -> StateModel | None:
        """The G that was learned where it is another one than `model`."""
        learning = self._learning
        learned = learning.learned.model
        if learned is self._following.model:
            return None
        # That of a fit which is not believed is no better than the one in use.
        known = learning.current is not None and learning.reason is not Status.INCONSISTENT
        return learned if known else None

    @property
    def learned_model(self) -> StateModel:
        """The G behind the newest estimates, whether or not a structure has taken it up."""
        return self._learning.learned.model

    @property
    def _unexplained(self) -> float:
        """Motion of u that no backlash and no G explains, over m times the gap.

        Where there is no estimate: of the last fit that gave none, nan before.
        """
        learning = self._learning
        fitted = learning.contradiction or learning.current or learning.acquisition.rejected
        return fitted.fit.unexplained(fitted.solution) if fitted is not None else nan

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        """Relative deviation of the true response from that of `learned_model` at z (M,).

        Shape (M,); nan before anything is learned, 0 where G was told to be exact.
        """
        current = self._learning.current
        if current is None:
            return np.full(len(z), nan)
        return response_std(current.fit, current.solution, self.learned_model, z)

    # --- what it is told ------------------------------------------------------------------------

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
        self._following.change_model(model)
        learning = self._learning
        if learning.current is not None:
            self._following.follow(
                learning.current, self.estimate, learning.record, self.learned_model
            )

    def retune(self, p: Parameters) -> None:
        """Take another first guess of the noise and the walk; whatever was learned stays."""
        learning = self._learning
        learning.told_walk = p.get_float('estimator.input_noise_std')
        drift_std = np.array(p.get_triple('estimator.drift_std'))
        learning.drift = drift_std * p.get_float('sample_period')**0.5
        noise_std = max(p.get_float('estimator.output_noise_std'), SMALLEST_NOISE)
        learning.around = learning.around._replace(told_std=noise_std)
        self._idle_until = 0

    # --- at every sample ------------------------------------------------------------------------

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        sample = self._following.step(y, interval, self.estimate, self._learning.record)
        if self._adapting:
            self._note(sample)
        status = self._status()
        if status is not self.estimate.status:
            self.estimate = replace(self.estimate, status=status)

    def _note(self, sample: Sample) -> None:
        learning, following = self._learning, self._following
        if following.since_motion > following.model.memory and self._rests():
            return
        if self._paused or len(learning.record) == CAPACITY:
            # The samples between are missing, or there was no time to take any in.
            self._paused = False
            self._restart_record()
        learning.record.append(sample.v, nan if sample.y is None else sample.y, sample.other)

    def _rests(self) -> bool:
        """Whether nothing has moved for so long that samples say no more."""
        learning, following = self._learning, self._following
        if not following.begun:
            # The next motion goes on from here as if at once, unless G drifts away meanwhile.
            still = following.since_motion > AT_REST * self.model.memory
            return still and not learning.around.error.integrates
        self._paused = True
        if learning.current is not None and following.since_motion % BLOCK[1] == 0:
            following.settle(learning.current.solution.posterior.noise_std)
        return True

    def _restart_record(self) -> None:
        self._end_task()
        try:
            self._learning.restart(self._following.start_of(self.estimate))
        except np.linalg.LinAlgError:
            self._search_afresh()

    def _search_afresh(self) -> None:
        """Go on after samples that leave nothing but rounding: others may be better."""
        self._failed_fits += 1
        learning = self._learning
        learning.record.forget_before(learning.record.end)
        learning.begin_acquisition(self.estimate if self.estimate.learned else None)

    def _status(self) -> Status:
        if self._lost_in_a_row >= NO_DATA:
            return Status.NO_DATA
        reason, following = self._learning.reason, self._following
        if not following.begun or reason is Status.INCONSISTENT:
            return reason
        if following.since_motion > following.model.memory:
            return Status.NOT_EXCITED
        return Status.TRACKING if self._learning.confirmed else Status.ACQUIRING

    # --- after the command -----------------------------------------------------------------------

    def refine(self, budget_s: float = inf) -> None:
        """Go on with the fit, in pieces, until nothing is left to do or the time is over."""
        timed = budget_s < inf
        begun = before = perf_counter() if timed else 0.0
        used = thread_time() if timed else 0.0
        task = self._due_task()
        if task is None:
            return
        # What is not finite is refused by the posterior.
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            while task is not None:
                try:
                    self._go_on(task)
                except np.linalg.LinAlgError:
                    self._end_task()
                    self._search_afresh()
                    return
                if timed:
                    now, used_before, used = perf_counter(), used, thread_time()
                    self._learning.pace.note(used - used_before, budget_s)
                    # Another piece that takes as long must fit in as well.
                    if 2.0 * now - before - begun > budget_s:
                        return
                    before = now
                task = self._due_task()

    def _due_task(self) -> Task | None:
        """The task that is under way, or the next one."""
        if self._task is not None or not self._adapting \
                or self._learning.record.end < self._idle_until:
            return self._task
        found = next_task(self._learning, self.estimate)
        if isinstance(found, int):
            self._idle_until = found
            return None
        self._task = found
        return found

    def _end_task(self) -> None:
        """Let no task be under way; another one may be due at once."""
        self._task, self._idle_until = None, 0

    def _go_on(self, task: Task) -> None:
        """Do another piece of the task, and publish what it leaves at its end."""
        try:
            next(task)
        except StopIteration as done:
            self._end_task()
            if done.value:
                self._publish()
            self._note_coasting()

    # --- what comes out --------------------------------------------------------------------------

    def _publish(self) -> None:
        """Make the newest fit the estimate where it is good enough, and go on from its state."""
        learning = self._learning
        current = learning.fit
        if denied_by_samples(learning, self.estimate):
            # The estimate was that of another plant.
            kept = learning.around.inherited
            learning.begin_acquisition(self.estimate if kept else None)
            learning.reason = Status.INCONSISTENT
            if not kept:
                learning.held = None
            return
        found = believable(learning)
        belief = judged(learning, found, self.estimate)
        if belief is Belief.REPLACES and found is not None:
            self._take_over(found)
        if belief is Belief.WIDENS and found is not None:
            e = self.estimate
            self._take_over(replace(found, m=e.m, c_r=e.c_r, c_l=e.c_l))
        if belief is Belief.REFUSED:
            learning.reason = Status.INCONSISTENT
        elif learning.contradicted_from is None:
            learning.reason = Status.TRACKING
        if belief is Belief.REFUSED and not self._following.begun:
            return
        self._following.follow(current, self.estimate, learning.record, self.learned_model)

    def _note_coasting(self) -> None:
        """Let motion of a load that coasts count as doubt of the gap, until it is over.

        A structure that shrinks it by its deviations pushes the load less.
        """
        learning, estimate = self._learning, self.estimate
        self._coasts = learning.reason is Status.INCONSISTENT and load_coasts(learning, estimate)
        stds = self._stds
        if self._coasts:
            doubt = 0.5 * self._unexplained * (estimate.c_r - estimate.c_l)  # of each crossing
            stds = hypot(stds[0], doubt), hypot(stds[1], doubt)
        if stds != (estimate.std_c_r, estimate.std_c_l) and estimate.learned:
            self.estimate = replace(estimate, std_c_r=stds[0], std_c_l=stds[1])

    def _take_over(self, found: Crossings) -> None:
        m, c_r, c_l = self._learning.bounds.project(found.m, found.c_r, found.c_l)
        self._learning.held = found.cov
        self._stds = found.std_c_r, found.std_c_l
        self.estimate = Estimate(
            m, c_r, c_l, self.estimate.f, found.std_m, found.std_c_r, found.std_c_l,
            self.estimate.status,
        )
