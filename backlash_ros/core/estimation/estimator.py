"""The default law: it records samples, lets fits be made elsewhere, and publishes what they say.

Moving-horizon estimation of the gap, the slope, the crossings, the error of G, the noise and the
state of G at once (C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for
nonlinear discrete-time systems, IEEE Trans. Automatic Control 48 (2003) 246-258). `update` takes
in a sample: play operator and observer advance (following.py). `refine` has the newest record
fitted where that is due (learning.py), in a worker process or at once, and goes on from its result,
whichever sample that belongs to. docs/estimation.md explains the method and measures it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import lru_cache
from math import hypot, inf, nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimate import Bounds, Estimate, Status
from backlash_ros.core.estimation.belief import Belief, Inherited
from backlash_ros.core.estimation.explanations import SMALLEST_NOISE, Record, Setup, with_swapped
from backlash_ros.core.estimation.following import Following, Place, place_of
from backlash_ros.core.estimation.learning import learn
from backlash_ros.core.estimation.observer import Gains, gains_of
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import Fit
from backlash_ros.core.estimation.settings import FEWEST, FIRST_FIT, LONGEST
from backlash_ros.core.jobs.executor import Executor, Failure, Samples
from backlash_ros.core.law import Interval, Law, LawReport
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.state_model import StateModel
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

NO_DATA = 20  # lost samples in a row that are worth a state
CAPACITY = LONGEST + 16_384  # samples that are kept where fits are made
WORTH = 1.0  # log-likelihood by which another G must be better to be proposed


class Proposal(NamedTuple):
    """A G that was learned, its xi (K,), and the gains of its observer."""

    model: StateModel
    xi: Array
    gains: Gains


class Fitted(NamedTuple):
    """What comes of a fit: what is believed, where play and G stand, a better G if there is one.

    gains: of the observer of the G whose state is wanted, where they were asked for.
    """

    belief: Belief
    place: Place | None = None
    proposal: Proposal | None = None
    gains: Gains | None = None


def fitted(
    samples: Samples, setup: Setup, before: Belief, model: TransferFunction, proposed: Array,
    with_gains: bool,
) -> Fitted:
    """What is believed with these samples: the job that is done beside the loop.

    model: the G whose state the structure wants. proposed: xi (K,) of the newest proposal.
    with_gains: whether the gains of the observer of `model` are wanted.
    """
    record = with_swapped(Record(samples.first, *samples.columns), before.swapped)
    belief = learn(setup, record.since(max(before.first, record.end - LONGEST)), before)
    if belief.fit is None or belief.published is None:
        return Fitted(belief)
    part = with_swapped(record, belief.swapped - before.swapped)
    part = part.since(belief.first).until(belief.end)
    place = place_of(belief.fit, part, model, setup.family.memory)
    gains = _gains_of(tuple(model.numerator), tuple(model.denominator)) if with_gains else None
    return Fitted(belief, place, _proposal(setup, belief, proposed), gains)


# Remembered: where jobs are done at once, every run of a process would make them anew.
@lru_cache(maxsize=16)
def _gains_of(numerator: tuple[float, ...], denominator: tuple[float, ...]) -> Gains:
    return gains_of(StateModel(TransferFunction(numerator, denominator)))


def _proposal(setup: Setup, belief: Belief, proposed: Array) -> Proposal | None:
    """The G of the fit where the one that was proposed before is less likely by 1 nat."""
    fit, count = belief.fit, setup.family.count
    if fit is None or not count or not belief.trusted:
        return None
    apart = fit.theta[3:] - proposed
    cov = fit.cov[3:, 3:] * fit.inflation + 1e-16 * np.eye(count)
    if 0.5 * float(apart @ np.linalg.solve(cov, apart)) <= WORTH:
        return None
    model = StateModel(setup.family.model_at(fit.xi))
    return Proposal(model, fit.theta[3:], gains_of(model))


class MovingHorizon(Law):
    """Learns (m, c_r, c_l) and the error of G from y alone.

    initial: a first guess, or with its deviations what was learned before. model: the nominal G.
    uncertainty: relative spread of its time constants, damping and delay, 0 where it is exact.
    noise_std: of y, a first guess. walk_std, drift_std: random walks of u and of m, c_r, c_l, per
    square root of a second; a walk_std of 0 is learned where the samples demand a walk. observer:
    gives the state of G until the backlash is known, for structures that want it.
    """

    RETUNED = (
        'estimator.output_noise_std', 'estimator.input_noise_std', 'estimator.drift_std',
    )

    def __init__(
        self, initial: Estimate, bounds: Bounds, model: StateModel, noise_std: float,
        walk_std: float, drift_std: tuple[float, float, float], sample_period: float,
        uncertainty: float, observer: FixedBacklash | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.estimate = replace(initial, status=Status.ACQUIRING)
        family = PlantFamily(model.transfer_function, uncertainty)
        self._setup = Setup(
            family, max(noise_std, SMALLEST_NOISE), bounds, bounds.c_r[1] - bounds.c_l[0],
            initial.c_r - initial.c_l, walk_std * sample_period**0.5,
            np.array(drift_std) * sample_period**0.5,
        )
        self._channel = (executor or Executor()).open(3, CAPACITY)
        self._end = 0  # samples so far
        self._newer: deque[tuple[float, float]] = deque(maxlen=CAPACITY)  # since the last fit
        self._belief = Belief(inherited=_inherited(initial), published=_values(initial))
        self._following = Following(model, observer)
        self._nominal = model
        self._model_known_before = initial.learned  # G was identified together with the backlash
        self._proposal: Proposal | None = None
        self._adapting, self._lost_in_a_row, self._failed_fits = True, 0, 0
        self._reattributed = 0  # intervals so far over which the other command acted
        self._skipping_fit = False  # whether the fit under way is of a record that was given up

    # --- what it says ----------------------------------------------------------------------------

    @property
    def model(self) -> StateModel:
        """The G that x_hat is the state of."""
        return self._following.model

    @property
    def covariance(self) -> Array | None:
        """Covariance of (m, c_r, c_l) behind the published deviations, shape (3, 3)."""
        return self._belief.cov

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
    def proposal(self) -> StateModel | None:
        """The G that was learned where it is another one than `model`."""
        proposal = self._proposal
        return None if proposal is None or proposal.model is self.model else proposal.model

    @property
    def learned_model(self) -> StateModel:
        """The G behind the newest estimates, whether or not a structure has taken it up."""
        return self._nominal if self._proposal is None else self._proposal.model

    @property
    def report(self) -> LawReport:
        """How its work goes."""
        belief = self._belief
        fit = belief.fit or belief.tried  # that of no use, where there is no other one
        return LawReport(
            noise_ratio=nan if belief.fit is None else belief.fit.noise / self._setup.noise_std,
            unexplained=nan if fit is None else fit.unexplained,
            unconfirmed=belief.inherited is not None and belief.fit is None,
            coasts=belief.coasts,
            wrong_sign=belief.tried is not None and belief.tried.m < 0.0,
            waiting=self._end - belief.end,
            outliers=self._following.outliers,
            reattributed=self._reattributed,
            failed_fits=self._failed_fits,
        )

    def response_std(self, z: NDArray[np.complex128]) -> Array:
        """Relative deviation of the true response from that of `learned_model` at z (M,).

        Shape (M,); nan before anything is learned, 0 where G is exact.
        """
        fit, family = self._belief.fit, self._setup.family
        if fit is None:
            return np.full(len(z), nan)
        slopes = family.response_slopes(fit.xi, z)
        cov = fit.cov[3:, 3:] * fit.inflation
        variance = np.einsum('ij,jk,ik->i', slopes, cov, slopes.conj()).real
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    # --- what it is told -------------------------------------------------------------------------

    @property
    def adapting(self) -> bool:
        """Whether it learns; otherwise it goes on following the state of G alone."""
        return self._adapting

    @adapting.setter
    def adapting(self, adapting: bool) -> None:
        if adapting and not self._adapting:
            self._begin_anew()
        self._adapting = adapting

    def _begin_anew(self) -> None:
        """Begin another record: the samples before it are not those before the next one."""
        before = self._belief
        inherited = before.inherited
        if inherited is None and before.published is not None and before.cov is not None:
            inherited = Inherited(before.published, before.cov)
        self._belief = Belief(
            first=self._end, end=self._end, next_at=self._end + FIRST_FIT,
            published=before.published, cov=before.cov, inherited=inherited,
        )
        self._skipping_fit = self._channel.busy

    def adopt(self, model: StateModel) -> None:
        """Give x_hat for this G from now on."""
        proposal = self._proposal
        known = proposal is not None and proposal.model is model
        self._following.change_model(model, proposal.gains if proposal and known else None)

    def retune(self, p: Parameters) -> None:
        """Take another first guess of the noise, the walk and the drift; what was learned stays."""
        root = p.sample_period**0.5
        self._setup = replace(
            self._setup, walk_std=p.estimator.input_noise_std * root,
            drift=np.array(p.estimator.drift_std) * root,
            noise_std=max(p.estimator.output_noise_std, SMALLEST_NOISE),
        )

    def close(self) -> None:
        """Give up the record where fits are made, and a fit under way."""
        self._channel.close()

    # --- at every sample -------------------------------------------------------------------------

    def update(self, y: float | None, interval: Interval) -> None:
        """Take in y(k), None if it was lost, and v of the interval before it."""
        self._lost_in_a_row = self._lost_in_a_row + 1 if y is None else 0
        following = self._following
        following.step(y, interval, self.estimate)
        if self._adapting and not (self._rests and not self._setup.family.integrates):
            value = nan if y is None else y
            self._channel.append(interval.v, value, interval.other)
            self._newer.append((interval.v, value))
            self._end += 1
        status = self._status()
        if status is not self.estimate.status:
            self.estimate = replace(self.estimate, status=status)

    @property
    def _rests(self) -> bool:
        """Whether nothing has moved for longer than G remembers."""
        return self._following.since_motion > self._setup.family.memory

    def _status(self) -> Status:
        if self._lost_in_a_row >= NO_DATA:
            return Status.NO_DATA
        reason = self._belief.reason
        resting = self._following.begun and self._rests
        if resting and reason is not Status.INCONSISTENT:
            return Status.NOT_EXCITED
        return reason

    def refine(self, budget_s: float = inf) -> None:
        """Take up a fit that is finished, and have the record fitted where that is due."""
        channel = self._channel
        if channel.busy:
            self._take(channel.poll())
        due = self._end >= self._belief.next_at or self._following.surprised
        resting = self._following.begun and self._rests
        if channel.busy or resting or not (due and self._adapting):
            return
        self._following.surprised = False
        count, proposal = self._setup.family.count, self._proposal
        proposed: Array = np.zeros(count) if proposal is None else proposal.xi
        channel.submit(
            fitted, self._setup, self._belief, self.model.transfer_function, proposed,
            self._following.gains is None, since=self._belief.first,
        )
        self._take(channel.poll())

    def _take(self, result: Fitted | Failure | None) -> None:
        """Go on from what is believed after the newest fit."""
        if result is None:
            return
        if self._skipping_fit:
            self._skipping_fit = False
            return
        if isinstance(result, Failure):
            self._failed_fits += 1
            self._belief = replace(self._belief, next_at=self._end + FEWEST)
            return
        before, self._belief = self._belief, result.belief
        self._reattributed += len(result.belief.swapped - before.swapped)
        belief = result.belief
        if belief.published is not None and (
            belief.published is not before.published or belief.coasts is not before.coasts
        ):
            self._publish(belief, belief.published)
        if result.proposal is not None and not self._model_known_before:
            self._proposal = result.proposal
        while len(self._newer) > self._end - belief.end:
            self._newer.popleft()
        if result.place is not None and belief.fit is not None:
            if result.gains is not None and self._following.is_of(result.place):
                self._following.gains = result.gains
            self._go_on_from(belief, belief.fit, result.place)

    def _publish(self, belief: Belief, values: Array) -> None:
        e = self.estimate
        m, c_r, c_l = self._setup.bounds.project(*values.tolist())
        stds = e.std_m, e.std_c_r, e.std_c_l
        if belief.cov is not None:
            std_m, std_c_r, std_c_l = np.sqrt(np.maximum(np.diag(belief.cov), 0.0)).tolist()
            stds = std_m, std_c_r, std_c_l
        if belief.coasts:
            # Motion of the load within the gap makes the gap doubtful: a structure that shrinks it
            # by its deviations pushes the load less.
            doubt = 0.5 * self.report.unexplained * (c_r - c_l)
            stds = stds[0], hypot(stds[1], doubt), hypot(stds[2], doubt)
        self.estimate = Estimate(m, c_r, c_l, e.f, *stds, e.status)

    def _go_on_from(self, belief: Belief, fit: Fit, place: Place) -> None:
        following = self._following
        if not belief.trusted and following.begun:
            following.settle(fit.noise)
            return
        following.go_on_from(place, self._newer, self.estimate, fit.noise, belief.trusted)


def _inherited(initial: Estimate) -> Inherited | None:
    values = _values(initial)
    if values is None:
        return None
    std = np.array([initial.std_m, initial.std_c_r, initial.std_c_l])
    return Inherited(values, np.diag(std**2))


def _values(initial: Estimate) -> Array | None:
    return np.array([initial.m, initial.c_r, initial.c_l]) if initial.learned else None
