"""A bank of Kalman filters on [x; theta], one per hypothesis on the gap width g = c_r - c_l.

Given g, the play operator says from v alone which side of the gap was engaged last and at which
v_a. Then u = phi' theta with theta = (m, m c_r, m c_l) and phi = (v_a, -1{right}, -1{left}), and
y is linear in everything unknown:

    x(k+1) = A x(k) + B phi(k)' theta,   y(k) = C x(k) + noise

so that a Kalman filter is the optimal estimator under each hypothesis, and the likelihood of its
innovations says how well the hypothesis fits. In the gap u is held: the last engaged phi goes on.

Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, Wiley 2001, section 11.6 (static multiple models).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from math import inf, log, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.crossings import Crossings, crossings_of
from backlash_ros.core.state_model import StateModel

Array = NDArray[np.float64]

# Rounding in the propagation is not symmetric; left alone it would grow.
SYMMETRISE_EVERY = 16
CROSSING_REACH = 2.0  # standard deviation of a crossing before the first sample, in gaps
STATE_REACH = 30.0  # standard deviation of x at the start, in terms of what was seen of y and v
PRECISION = 1e-7  # least ratio of the deviations of the noise and of x at the start
IMPLAUSIBLE = 1e4  # standard deviations of the prior that no theta is away from 0
IMPOSSIBLE = -1e12  # log-likelihood of a hypothesis that is out
TINY = 1e-300  # keeps a division finite
ELECT_EVERY = 4  # corrections between two looks for the most likely hypothesis
NIS_MEMORY = 1.0 / 40.0  # the mean of a true hypothesis is 1, its standard deviation then 0.16
SIGN_MARGIN = 10.0  # log-likelihood by which a hypothesis with m > 0 may be behind one without
LATE_CAP = 9.0  # largest normalised innovation squared that late starters pay for
NIS_CAP = 36.0  # a wild sample counts as one of six standard deviations


@dataclass(frozen=True)
class Prior:
    """What is believed of theta = (m, m c_r, m c_l) before the first sample.

    theta: shape (3,). slope_std: of m. Given g, neither crossing is further from 0 than g, which
    bounds what is believed of the products. inherited: covariance of theta (3, 3) where it was
    learned before; it replaces both.
    """

    theta: Array
    slope_std: float
    inherited: Array | None = None

    def covariances(self, gaps: Array) -> Array:
        """Covariance of theta per hypothesis, shape (H, 3, 3)."""
        if self.inherited is not None:
            return np.tile(self.inherited, (len(gaps), 1, 1))
        product = (CROSSING_REACH * self.slope_std * gaps) ** 2
        covariances = np.zeros((len(gaps), 3, 3))
        covariances[:, 0, 0] = self.slope_std**2
        covariances[:, 1, 1] = covariances[:, 2, 2] = product
        return covariances


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white noise on y and on u, and the drift of theta per sample.

    drift_var: covariance, shape (3, 3); None where theta is constant.
    """

    output_std: float
    input_std: float = 0.0
    drift_var: Array | None = None


@dataclass(frozen=True)
class Start:
    """What is known of a record before it is read.

    reaches: of the play operators before the first sample, shape (H,). swing_of_y: highest less
    lowest y. largest_v: largest |v|.
    """

    reaches: Array
    swing_of_y: float
    largest_v: float


class GapBank:
    """Kalman filters for gap widths g (H,), ascending, stepped together.

    A hypothesis starts when v has swung over its whole gap for the first time: only then is it
    certain which side is engaged, whatever u was held at before. Until then it is charged what a
    true model would cost per sample, so that early and late starters can be compared.

    noise: what is added per sample. tolerance: relative width of g that one hypothesis stands
    for. with_null: put the hypothesis "v never engaged: u is a constant" in front as row 0, for
    which theta[0] is that constant. start: with it no hypothesis waits, u is known from the first
    sample on.
    """

    def __init__(
        self, gaps: Array, model: StateModel, prior: Prior, noise: Noise,
        tolerance: float = 0.0, with_null: bool = False, start: Start | None = None,
    ) -> None:
        if with_null:
            gaps = np.concatenate([[0.0], gaps])
        n, count = model.order, len(gaps)
        self.gaps = gaps.copy()
        self._model, self._n, self._first = model, n, 1 if with_null else 0
        self.tolerance = tolerance
        self._least_noise_var = 0.0
        self.set_noise(noise)
        self.mean = np.zeros((count, n + 3))
        self.mean[:, n:] = prior.theta
        self.cov = np.zeros((count, n + 3, n + 3))
        widest = np.where(gaps > 0.0, gaps, gaps.max())  # the null hypothesis may hold any u
        believed = prior.covariances(widest)
        self.cov[:, n:, n:] = believed
        self._plausible = IMPLAUSIBLE * np.sqrt(believed.diagonal(axis1=1, axis2=2).max(axis=1))
        self.log_likelihood = np.zeros(count)
        self._paid = np.zeros(count)  # log-likelihood that learning x and theta has cost
        self.active = 0  # hypotheses [:active] have started
        self.since_motion = 0  # samples since u last moved under the leader
        self.turned = False  # whether the leader engaged the other side with the last step
        self.leader = 0  # most likely hypothesis that has started
        self.doubt = np.zeros((3, 3))  # covariance of theta that comes from not knowing the gap
        self.innovation = nan  # of the leader
        self.innovation_var = self.noise_var
        self._nis = np.ones(count)  # running means of the normalised innovations squared
        self._transition = np.tile(np.eye(n + 3), (count, 1, 1))
        self._transition[:, :n, :n] = model.a
        self._at_once = start
        # q of the play operator: clamped between v and v + g.
        self._reach = np.zeros(count) if start is None else start.reaches.copy()
        self._left = np.zeros(count)  # 1 where the left side was engaged last
        self._phi = np.zeros((count, 3))
        self._phi[0, 0] = 1.0  # for good under the null hypothesis
        self._v_low, self._v_high = inf, -inf  # swing of v so far
        self._y_low, self._y_high, self._y = inf, -inf, 0.0  # swing of y so far, newest y
        self._kick = float(np.linalg.norm(model.b)) * float(prior.theta[0])
        self._corrections = 0

    def set_noise(self, noise: Noise) -> None:
        """Expect this noise from now on."""
        n, b = self._n, self._model.b
        self.noise_var = max(noise.output_std**2, self._least_noise_var)
        self._process_var: Array | None = None
        if noise.input_std > 0.0 or noise.drift_var is not None:
            self._process_var = np.zeros((n + 3, n + 3))
            self._process_var[:n, :n] = noise.input_std**2 * np.outer(b, b)
            if noise.drift_var is not None:
                self._process_var[n:, n:] = noise.drift_var

    @property
    def begins_at_once(self) -> bool:
        """Whether no hypothesis waits until v has swung over its gap."""
        return self._at_once is not None

    @property
    def nis(self) -> float:
        """Running mean of the leader's normalised innovation squared, 1 for a true model."""
        return float(self._nis[self.leader])

    def forgive(self) -> None:
        """Begin to judge the innovations anew."""
        self._nis[:] = 1.0

    @property
    def swing(self) -> float:
        """How far v has swung so far."""
        return max(self._v_high - self._v_low, 0.0)

    @property
    def theta(self) -> Array:
        """Estimates of (m, m c_r, m c_l) per hypothesis, shape (H, 3)."""
        return self.mean[:, self._n:]

    @property
    def theta_cov(self) -> Array:
        """Covariances of theta per hypothesis, shape (H, 3, 3)."""
        return self.cov[:, self._n:, self._n:]

    def elect(self) -> float:
        """Make the most likely hypothesis the leader and return its log-likelihood.

        A hypothesis g that fits the data with another m (c_r - c_l) than m g contradicts itself:
        its own gap counts as one more measurement, m g of theta[1] - theta[2]. What learning x
        and theta costs in likelihood is made equal: else a hypothesis that has just started,
        and has paid little of it, would lead over the true one. How far the
        estimates of likely hypotheses lie apart is kept as `doubt`.
        """
        rows = slice(self._first, self.active)
        gaps, theta, cov = self.gaps[rows], self.theta[rows], self.theta_cov[rows]
        lost = ~np.isfinite(self.log_likelihood[:self.active])
        lost[rows] |= ~(np.abs(theta).max(axis=1, initial=0.0) <= self._plausible[rows])
        if lost.any():
            self._give_up(np.flatnonzero(lost))
        weights = np.empty((len(gaps), 3))
        weights[:, 0], weights[:, 1], weights[:, 2] = -gaps, 1.0, -1.0
        mismatch = (weights * theta).sum(axis=1)
        variance = ((weights[:, None, :] @ cov)[:, 0, :] * weights).sum(axis=1)
        # Rounding may leave it below 0, and it is 0 for those that are out.
        variance = np.maximum(variance, TINY) + (self.tolerance * gaps * theta[:, 0]) ** 2
        score = self.log_likelihood[:self.active].copy()
        score[rows] -= 0.5 * (mismatch**2 / variance + np.log(variance))
        paid = self._paid[rows]
        score[rows] += paid - paid.max(initial=-inf)
        # A slope below 0 is wrong; a hypothesis that is far less likely is no better for it.
        hopeful = score.copy()
        hopeful[rows][theta[:, 0] <= 0.0] = -inf
        if hopeful.max() > score.max() - SIGN_MARGIN:
            score = hopeful
        self.leader = leader = int(score.argmax())
        if leader >= self._first and score[leader] > -inf:
            share = np.exp(score[rows] - score[leader])
            apart = theta - theta[leader - self._first]
            self.doubt = (apart.T * (share / share.sum())) @ apart
        return float(score[leader])

    def _give_up(self, rows: NDArray[np.intp]) -> None:
        """Take hypotheses out that contradict the data so much that rounding has taken over."""
        self.mean[rows], self.cov[rows] = 0.0, 0.0
        self.log_likelihood[rows] = self._paid[rows] = IMPOSSIBLE
        self._nis[rows] = NIS_CAP

    def found(self) -> Crossings | None:
        """Estimate of the leader, the doubt about the gap included; None unless m > 0."""
        return crossings_of(self.theta[self.leader], self.theta_cov[self.leader] + self.doubt)

    def u_hat(self) -> float:
        """u under the leading hypothesis after the last step."""
        return float(self._phi[self.leader] @ self.theta[self.leader])

    def part(self, first: int, last: int) -> GapBank:
        """A bank of the started hypotheses [first:last] alone, with all they have learned."""
        part = copy.copy(self)
        rows = slice(first, last)
        for name in (
            'gaps', 'mean', 'cov', 'log_likelihood', '_plausible', '_transition', '_reach',
            '_left', '_phi', '_paid', '_nis',
        ):
            setattr(part, name, getattr(self, name)[rows].copy())
        part.active, part._first = last - first, 0
        part.elect()
        return part

    def move_gaps(self, gaps: Array) -> None:
        """Give the hypotheses other gaps (H,), ascending; what they have learned stays."""
        # v_a = q - g of a left engagement must not move with g.
        self._reach += self._left * (gaps - self.gaps)
        self.gaps = gaps

    def predict(self, v: float) -> None:
        """Go from k-1 to k with v applied in between."""
        before = self.active
        if before < len(self.gaps):
            self._start(v)
        if before:
            self._play(before, v)
            self._propagate(before)

    def _charge_late_starters(self, square: float) -> None:
        """Let hypotheses that have not started pay for a sample what a true model would.

        square: normalised innovation squared of the leader, which is taken for true: so they
        share its luck.
        """
        square = min(square, LATE_CAP)
        self.log_likelihood[self.active:] -= 0.5 * (square + log(self.noise_var))

    def _start(self, v: float) -> None:
        """Start the hypotheses whose whole gap v has swung over with this sample."""
        rising = v > self._v_high
        if not (rising or v < self._v_low):
            return
        self._v_low, self._v_high = min(v, self._v_low), max(v, self._v_high)
        before = self.active
        # Who has started goes on, even if its gap has moved beyond the swing since.
        self.active = max(before, int(np.searchsorted(self.gaps, self.swing, side='right')))
        if self.begins_at_once:
            self.active = len(self.gaps)
        new = slice(before, self.active)
        upper = v + self.gaps[new]
        if self.begins_at_once:
            self._reach[new] = np.clip(self._reach[new], v, upper)
        else:
            self._reach[new] = v if rising else upper
        self._left[new] = self._reach[new] >= upper
        self._set_phi(new)
        self._set_state(new)

    def _set_state(self, new: slice) -> None:
        """Believe of x that it is near the equilibrium of the newest y, give or take a lot."""
        n, start = self._n, self._at_once
        if start is not None:
            largest, swing = start.largest_v, start.swing_of_y
        else:
            largest = max(abs(self._v_low), abs(self._v_high))
            swing = max(self._y_high - self._y_low, 0.0)
        std = STATE_REACH * (swing + self._kick * largest + sqrt(self.noise_var))
        # Covariances of doubles do not span more orders of magnitude than this.
        self._least_noise_var = (PRECISION * std) ** 2
        self.noise_var = max(self.noise_var, self._least_noise_var)
        self.mean[new, :n] = self._model.equilibrium * self._y
        diagonal = np.arange(n)
        self.cov[new, diagonal, diagonal] = std**2
        # Every filter pays once for how little it believes of x; repaid, so that filters that
        # believed differently can be compared.
        self.log_likelihood[new] += n * log(std)
        self._paid[new] -= n * log(std)

    def _play(self, count: int, v: float) -> None:
        """Move the play operators; phi is that of the last engagement."""
        rows = slice(self._first, count)
        reach, left = self._reach[rows], self._left[rows]
        before, side = self._reach[self.leader], self._left[self.leader]
        upper = v + self.gaps[rows]
        on_left, on_right = reach >= upper, reach <= v
        if on_left.any() or on_right.any():
            left[on_left], left[on_right] = 1.0, 0.0
            np.minimum(np.maximum(reach, v, out=reach), upper, out=reach)
            self._set_phi(rows)
        self.since_motion = self.since_motion + 1 if self._reach[self.leader] == before else 0
        self.turned = bool(self._left[self.leader] != side)

    def _set_phi(self, rows: slice) -> None:
        rows = slice(max(rows.start, self._first), rows.stop)
        left, phi = self._left[rows], self._phi[rows]
        phi[:, 0] = self._reach[rows] - left * self.gaps[rows]
        phi[:, 1] = left - 1.0
        phi[:, 2] = -left

    def _propagate(self, count: int) -> None:
        n, transition = self._n, self._transition[:count]
        mean, cov = self.mean[:count], self.cov[:count]
        transition[:, :n, n:] = self._model.b[:, None] * self._phi[:count, None, :]
        mean[:] = (transition @ mean[:, :, None])[:, :, 0]
        np.matmul(transition @ cov, transition.transpose(0, 2, 1), out=cov)
        if self._process_var is not None:
            cov += self._process_var

    def correct(self, y: float, gate: float = inf, learn: bool = True) -> bool:
        """Take in y(k); return False if it was refused as an outlier.

        gate: largest innovation of the leader in standard deviations. learn: False holds theta
        and corrects x alone, its covariance still counting theta as unknown (Schmidt's filter).
        """
        self._y_low, self._y_high = min(y, self._y_low), max(y, self._y_high)
        self._y = y
        count, n = self.active, self._n
        if not count:
            self._charge_late_starters(1.0)
            return True
        mean, cov = self.mean[:count], self.cov[:count]
        c = self._model.c
        cross = c * cov[:, :, 0]
        # Rounding may leave an all but certain x with a variance below 0.
        variance = np.maximum(c * cross[:, 0], 0.0) + self.noise_var
        e = y - c * mean[:, 0]
        leader = self.leader
        self.innovation, self.innovation_var = float(e[leader]), float(variance[leader])
        squares = e * e / variance
        nis = self._nis[:count]
        nis += NIS_MEMORY * (np.minimum(squares, NIS_CAP) - nis)
        if squares[leader] > gate * gate:
            return False
        self._charge_late_starters(float(squares[leader]))
        scaled = cross / variance[:, None]
        if learn:
            mean += scaled * e[:, None]
            cov -= scaled[:, :, None] * cross[:, None, :]
        else:
            mean[:, :n] += scaled[:, :n] * e[:, None]
            learned = cov[:, n:, n:].copy()
            cov -= scaled[:, :, None] * cross[:, None, :]
            cov[:, n:, n:] = learned
        self._corrections += 1
        if self._corrections % SYMMETRISE_EVERY == 0:
            cov[:] = 0.5 * (cov + cov.transpose(0, 2, 1))
        spread = np.log(variance)
        self.log_likelihood[:count] -= 0.5 * (squares + spread)
        self._paid[:count] += 0.5 * (spread - log(self.noise_var))
        if self._corrections % ELECT_EVERY == 0:
            self.elect()
        return True
