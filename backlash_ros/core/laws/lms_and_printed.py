"""Laws that learn from u as reconstructed from y: normalized LMS, and the law as printed.

LMS is the recursion that the paper describes in words (section 3.2). With theta =
(m, m c_r, m c_l) and phi = (v, -1{right}, -1{left}), u = theta' phi while a side is engaged. The
products are learned, as the error is linear in them, but not in c_r and c_l:

    theta(k+1) = theta(k) + step e W phi / (phi' W phi),   e = u - theta' phi

W = diag(1/v_max^2, 1, 1) scales the regressors of slope and crossings to the same size.
f follows the gradient of J = E{(u - u_d)^2} (3.6): f(k+1) = f(k) + step_f (u - u_d) v / (1 + v^2).

The four printed quotients (3.11) reduce to the single equation e = u - u_d = 0, solved for one
unknown at a time. One equation cannot identify four unknowns (docs/paper.md):

    f   = m (u - y_m) / (u + m w)         m   = u f / (u - y_m - f w)
    c   = (u - y_m) / f - u / m           (c_r and c_l alike)

Reference: S. Haykin, Adaptive Filter Theory, Prentice-Hall 1996, chapter 9 (the paper's [6]).
"""

from collections import deque
from math import isfinite, nan

from backlash_ros.core.estimate import Estimate, Status
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.input_reconstruction import (
    LEAST_SQUARE,
    Agreement,
    InputReconstruction,
)
from backlash_ros.core.parameters import Bounds, Parameters

STROKE = 8  # samples before and after u(k) over which u must move in one direction


class LaggedLaw(Law):
    """Learns from u, reconstructed with a lag, and from what was applied when that u acted."""

    innovation, u_hat = nan, 0.0

    def __init__(
        self, initial: Estimate, bounds: Bounds, f_bounds: tuple[float, float],
        reconstruction: InputReconstruction,
    ) -> None:
        self.estimate, self._bounds, self._f_bounds = initial, bounds, f_bounds
        self._reconstruction = reconstruction
        self._applied: deque[Interval] = deque(maxlen=reconstruction.lag)
        self._past: deque[float] = deque([0.0, 0.0], maxlen=STROKE + 1)
        self._agreement = Agreement()

    @property
    def x_hat(self) -> list[float]:
        return self._reconstruction.x_hat

    def update(self, y: float | None, interval: Interval) -> None:
        """Process y(k) and learn from the sample that the reconstruction has reached."""
        self.u_hat = u = self._reconstruction.update(y)
        self.innovation = self._reconstruction.innovation
        self._past.append(u)
        self._applied.append(interval)  # the newest carried u(k-1), the oldest u(k-lag)
        if not (self.adapting and self._reconstruction.ready):
            return
        past, rising = self._applied[0], self._rising(u)
        self.estimate = self._learned(u, past, rising)
        if rising is not None:
            row = (past.v, -1.0, 0.0, u) if rising else (past.v, 0.0, -1.0, u)
            self.estimate = self._agreement.judged(self.estimate, row)

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        raise NotImplementedError

    def _rising(self, u: float) -> bool | None:
        """Whether u moves on the right line (True) or the left one (False); None if it may rest.

        It moves if it changes by more than two standard deviations of its error to either side, as
        smoothing rounds corners, and at a quarter of the mean speed of the stroke or faster.
        """
        ahead, behind = self._reconstruction.newer(STROKE) - u, u - self._past[0]
        step, rising = u - self._past[-2], True
        if min(ahead, behind, step) < 0.0:
            ahead, behind, step, rising = -ahead, -behind, -step, False
        slowest = min(ahead, behind)
        resting = slowest <= 2.0 * self._reconstruction.std or step < 0.25 * slowest / STROKE
        return None if resting else rising


class NormalisedLms(LaggedLaw):
    """LMS for (m, m c_r, m c_l) and f, with u reconstructed from y.

    step: gain, 0 < step < 2. step_f: that of f, 0 keeps f. Nothing is learned if y moves against v.
    """

    RETUNED = ('lms.step', 'lms.step_f')

    def __init__(
        self, initial: Estimate, bounds: Bounds, f_bounds: tuple[float, float],
        reconstruction: InputReconstruction, step: float = 1.0, step_f: float = 0.0,
    ) -> None:
        super().__init__(initial, bounds, f_bounds, reconstruction)
        self.step, self.step_f = step, step_f
        self._v_max = 0.0

    def retune(self, p: Parameters) -> None:
        self.step, self.step_f = p.lms.step, p.lms.step_f

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        old, v = self.estimate, past.v
        if rising is None or old.status is Status.INCONSISTENT:
            return old
        m, c_r, c_l, f = old.m, old.c_r, old.c_l, old.f
        self._v_max = max(self._v_max, abs(v))
        e = u - m * (v - (c_r if rising else c_l))
        weight = 1.0 / self._v_max**2 if self._v_max**2 > LEAST_SQUARE else 0.0
        gain = self.step * e / (weight * v * v + 1.0)
        # The products are updated; the crossings follow by division.
        product_r = m * c_r - gain if rising else m * c_r
        product_l = m * c_l if rising else m * c_l - gain
        if self.step_f > 0.0:
            f += self.step_f * (u - past.u_d) * v / (1.0 + v * v)
            f = min(max(f, self._f_bounds[0]), self._f_bounds[1])
        m, c_r, c_l = self._bounds.of_products(m + gain * weight * v, product_r, product_l)
        return Estimate(m, c_r, c_l, f, status=old.status)


def printed_f(u: float, y_m: float, m: float, w: float) -> float:
    """f = F_n / F_d of (3.11); nan if F_d is 0."""
    numerator = u * y_m * m**2 + u * w * m**3 - y_m**2 * m**2 - y_m * m**3 * w
    denominator = u * y_m * m + y_m * w * m**2 + w**2 * m**3 + u * w * m**2
    return numerator / denominator if denominator != 0.0 else nan


def printed_m(u: float, y_m: float, f: float, w: float) -> float:
    """m = M_n / M_d of (3.11); nan if M_d is 0."""
    numerator = u * y_m * f**2 + u * f**3 * w
    denominator = u * y_m * f + u * f**2 * w - y_m**2 * f - 2.0 * y_m * f**2 * w - f**3 * w**2
    return numerator / denominator if denominator != 0.0 else nan


def printed_c(u: float, y_m: float, f: float, m: float) -> float:
    """c_r = C_1n / C_1d or c_l = C_2n / C_2d of (3.11), the same formula; nan if C_1d is 0."""
    numerator = u * f * m**2 - u * f**2 * m - y_m * m**2 * f
    denominator = f**2 * m**2
    return numerator / denominator if denominator != 0.0 else nan


class PrintedLaw(LaggedLaw):
    """Equations (3.11), evaluated in the printed order, each with the newest values.

    A quotient that is not finite is skipped; others are clipped to their bounds.
    """

    _upward, _u_before = True, 0.0

    def _learned(self, u: float, past: Interval, rising: bool | None) -> Estimate:
        old = self.estimate
        # w is c_r in the upward region, c_l in the downward one, and keeps its value in the gap.
        if u != self._u_before:
            self._upward = u > self._u_before
        upward, self._u_before = self._upward, u
        w = old.c_r if upward else old.c_l
        f = _guarded(printed_f(u, past.y_m, old.m, w), old.f, self._f_bounds)
        m = _guarded(printed_m(u, past.y_m, f, w), old.m, self._bounds.m)
        c = printed_c(u, past.y_m, f, m)
        c_r = _guarded(c, old.c_r, self._bounds.c_r) if upward else old.c_r
        c_l = old.c_l if upward else _guarded(c, old.c_l, self._bounds.c_l)
        return Estimate(m, c_r, c_l, f, status=old.status)


def _guarded(value: float, old: float, bounds: tuple[float, float]) -> float:
    return min(max(value, bounds[0]), bounds[1]) if isfinite(value) else old
