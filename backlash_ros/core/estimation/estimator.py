"""The default law: records samples, has them fitted outside the loop, publishes the results.

Moving-horizon estimation (C. V. Rao et al., IEEE Trans. Automatic Control 48 (2003) 246-258).
"""

from contextlib import suppress
from dataclasses import replace
from math import hypot, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.estimation import settings
from backlash_ros.core.estimation.belief import Belief, Kept, Known
from backlash_ros.core.estimation.explanations import Setup
from backlash_ros.core.estimation.observer import Following, Place
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.state_machine import learn
from backlash_ros.core.estimation.unmodelled import as_known
from backlash_ros.core.jobs import Executor, Failure
from backlash_ros.core.law import Interval, Law, LawReport
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.parameters import Bounds, Parameters
from backlash_ros.core.plant.numerics import Gain, gains_of, response_std, state_after, std_of
from backlash_ros.core.plant.transfer_function import Array, StateModel, TransferFunction
from backlash_ros.core.window import Recorder, Window


class Proposal(NamedTuple):
    """A learned G, its xi (K,), and gains of its observer."""

    model: StateModel
    xi: Array
    gains: tuple[Gain, ...] = ()


class Fitted(NamedTuple):
    """Result of a fitting job: belief, where play and G stand, and a better G if there is one."""

    belief: Belief
    place: Place | None = None
    better: Proposal | None = None


@np.errstate(all='ignore')
def fitted(
    samples: Window, setup: Setup, before: Belief, model: TransferFunction, proposed: Array,
) -> Fitted:
    """Update the belief with these samples: the job that is done outside the loop.

    model: G in use, whose state is wanted. proposed: xi of the newest proposal (K,).
    """
    record = samples.swapped(before.kept.swapped)
    belief = learn(setup, record.between(record.end - settings.LONGEST), before)
    fit, kept = belief.fit, belief.kept
    if fit is None or belief.published is None:
        return Fitted(belief)
    part = record.swapped(kept.swapped ^ before.kept.swapped).between(kept.first, belief.end)
    problem, crossings, noise = setup.problem(part, kept.older), fit.crossings, fit.noise
    if belief.inherited is not None:
        crossings = belief.published.crossings
        with suppress(np.linalg.LinAlgError):  # x and xi that suit it
            fit = problem.holding(*crossings.tolist()).fitted(fit)
    if fit.wiener:
        fit = as_known(problem, crossings, fit)
        noise = fit.left.rms
    run, last = problem.at(fit), min(len(part.v), 4 * setup.family.memory, settings.ROWS)
    u, y = run.u[-last:], part.y[-last:]
    place = Place(float(run.p[-1]), u, y, model, state_after(model, u, y), crossings, noise)
    if not len(proposed) or not belief.trusted or fit.behind(proposed) <= 1.0:
        return Fitted(belief, place)
    better = StateModel(setup.family.model_at(fit.xi))
    return Fitted(belief, place, Proposal(better, fit.theta[3:], gains_of(better)))


class MovingHorizon(Law):
    """Learns (m, c_r, c_l) and the error of G from v and y alone.

    initial: a first guess or, if it has standard deviations, an earlier result. observer: provides
    the state of G until the backlash is known, for structures that need it.
    """

    RETUNED = 'estimator.output_noise_std', 'estimator.input_noise_std', 'estimator.drift_std'

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, p: Parameters,
        observer: FixedBacklash | None = None, executor: Executor | None = None,
    ) -> None:
        self.estimate = replace(initial, status=Status.ACQUIRING)
        family = PlantFamily(model.transfer_function, p.plant.uncertainty)
        self._setup = Setup(family, 0.0, bounds, bounds.c_r[1] - bounds.c_l[0],
                            initial.c_r - initial.c_l, 0.0, np.zeros(3))
        self.retune(p)
        self._record = Recorder(settings.LONGEST)
        self._channel = (executor or Executor()).open()
        self._belief = Belief()
        if initial.learned:
            std = np.array([initial.std_m, initial.std_c_r, initial.std_c_l])
            known = Known(np.array([initial.m, initial.c_r, initial.c_l]), np.diag(std**2))
            self._belief = Belief(inherited=known, published=known)
        self._following, self._followed = Following(model, observer), self.estimate
        self._proposed = Proposal(model, np.zeros(family.count))
        self._recording = True  # whether learning was on at the newest sample
        self._lost_in_a_row = self._failed_fits = self._reattributed = 0
        self._skipping_fit = False  # whether to ignore the fit under way

    @property
    def u_hat(self) -> float:
        return self._following.u

    @property
    def x_hat(self) -> list[float]:
        return self._following.x_hat

    @property
    def x_cov(self) -> Array | None:
        observer = self._following.observer
        return None if observer is None else observer.cov

    @property
    def innovation(self) -> float:
        return self._following.innovation

    @property
    def proposal(self) -> StateModel | None:
        return None if self.learned_model is self._following.model else self.learned_model

    @property
    def learned_model(self) -> StateModel:
        return self._proposed.model

    @property
    def report(self) -> LawReport:
        belief, found, setup = self._belief, self._belief.found, self._setup
        fit = belief.fit or found
        outside = setup.outside_bounds(found) if found and setup.is_precise(found) else []
        return LawReport(
            noise_ratio=nan if belief.fit is None else belief.fit.noise / setup.noise_std,
            unexplained=nan if fit is None else fit.unexplained, reattributed=self._reattributed,
            unconfirmed=belief.holds or (belief.inherited is not None and belief.fit is None),
            wrong_sign=found is not None and setup.moves_against(found), coasts=belief.coasts,
            reversals=nan if belief.published or not found or found.m <= 0.0 else found.left.turns,
            forbidden=outside[0] if outside else None, waiting=self._record.end - belief.end,
            overdue=max(self._record.end - belief.next_at, 0) if self._channel.busy else 0,
            outliers=self._following.outliers, failed_fits=self._failed_fits)

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        fit = self._belief.fit
        return np.full(len(z), nan) if fit is None else response_std(
            self._setup.family, fit.xi, fit.cov_xi, z)

    def adopt(self, model: StateModel) -> None:
        if model is not self._proposed.model:  # learned by the law before this one
            self._proposed = self._proposed._replace(model=model, gains=())
        self._following.change_model(model, self._proposed.gains)

    def retune(self, p: Parameters) -> None:
        root, e = p.sample_period**0.5, p.estimator
        self._setup = replace(self._setup, noise_std=max(e.output_noise_std, 1e-12),
                              walk_std=e.input_noise_std * root, drift=np.array(e.drift_std) * root)

    def close(self) -> None:
        self._channel.close()

    def update(self, y: float | None, interval: Interval) -> None:
        if self.adapting is not self._recording:
            self._skipping_fit = self._channel.busy  # it knows of no sample after the change
        if self.adapting and not self._recording:
            # Start a new record: samples before the pause do not join those after it.
            before, end = self._belief, self._record.end
            self._belief = Belief(kept=Kept(first=end), end=end, next_at=end + settings.FIRST_FIT,
                                  published=before.published,
                                  inherited=before.inherited or before.published)
        self._recording = self.adapting
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        following, family = self._following, self._setup.family
        following.step(y, interval, self._followed)
        # While v rests, nothing is recorded once the transients of G have died out. What v does
        # within the gap is recorded: the true gap may be narrower than it seems.
        if self.adapting and (family.integrates or following.since_v_moved <= family.memory):
            self._record.append(interval.v, nan if y is None else y, interval.other)
        status = Status.ACQUIRING if self._belief.holds else self._belief.reason
        if self._lost_in_a_row >= 20:
            status = Status.NO_DATA
        elif following.observer is not None and following.since_motion > family.memory \
                and status is not Status.INCONSISTENT:
            status = Status.NOT_EXCITED
        if status is not self.estimate.status:
            self.estimate = replace(self.estimate, status=status)

    def prepare(self) -> None:
        if source := self._following.observer or self._following.before:
            source.prepare()

    def refine(self) -> None:
        channel, following, setup = self._channel, self._following, self._setup
        if channel.busy:
            self._accept(channel.poll())
            return  # to begin the next fit as well would take twice as long
        resting = following.observer and following.since_motion > setup.family.memory
        due = self._record.end >= self._belief.next_at and not resting
        empty = self._record.end <= self._belief.kept.first
        if not self.adapting or empty or not (due or following.surprised):
            return
        following.beyond += following.surprised  # only once per surprise
        channel.submit(fitted, self._record.since(self._belief.kept.first), setup, self._belief,
                       following.model.transfer_function, self._proposed.xi)
        self._accept(channel.poll())

    def _accept(self, result: Fitted | Failure | None) -> None:
        if result is None or self._skipping_fit:
            self._skipping_fit = self._skipping_fit and result is None
            return
        if isinstance(result, Failure):
            self._failed_fits += 1
            self._belief = self._belief._replace(next_at=self._record.end + settings.FEWEST)
            return
        before, belief, following = self._belief, result.belief, self._following
        self._belief, place, fit = belief, result.place, belief.fit
        self._reattributed += len(belief.kept.swapped - before.kept.swapped)
        news = belief.published is not before.published or belief.coasts is not before.coasts
        if belief.published is not None and news:
            self.estimate = self._estimate_of(belief, belief.published)
        self._followed = self.estimate
        if place is None or fit is None:
            return
        self._proposed = result.better or self._proposed
        if not belief.trusted and following.observer is not None:
            following.observer.settle(place.noise)  # no fit gives the state
            return
        m, c_r, c_l = place.crossings.tolist()
        self._followed = replace(self.estimate, m=m, c_r=c_r, c_l=c_l)
        newer = self._record.since(belief.end)
        following.go_on_from(place, np.array([newer.v, newer.y]), self._followed, belief.trusted)

    def _estimate_of(self, belief: Belief, known: Known) -> Estimate:
        values, e = self._setup.bounds.project(*known.crossings.tolist()), self.estimate
        std_m, std_c_r, std_c_l = std_of(known.cov).tolist()
        fit = belief.fit or belief.found
        if belief.coasts and fit is not None:
            # The gap is doubtful: a structure that shrinks it by its deviations pushes less.
            doubt = 0.5 * fit.unexplained * fit.gap
            std_c_r, std_c_l = hypot(std_c_r, doubt), hypot(std_c_l, doubt)
        return Estimate(*values, e.f, std_m, std_c_r, std_c_l, e.status)
