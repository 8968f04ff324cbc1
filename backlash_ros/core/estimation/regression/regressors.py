"""The columns of the regression: how y depends on the start, on u, on theta and on Delta.

For labels R, L (side engaged last) and H (not engaged yet) that the play operator gives for v, with
v_a the v of the last engaged sample and p the play output,

    y = F x0 + (G v_a) m - (G 1_R) m c_r - (G 1_L) m c_l + (G 1_H) u0 + sum_i (m xi_i) E_i

is linear. F is the free response of G from the state x0 before the first sample, u0 the u held
before the first engagement, and E the responses of (1 - z^-1) F_i G to p, in the coordinates in
which the xi_i are independent and of variance one a priori (error_model.py), around the G that was
told: its error, where G has been moved from it, is part of the column of m.

An integrator of G that in truth leaks, 1/(1 - (1 - l) z^-1), adds -l sum y to first order.

A disturbance of u that walks is a sum of ramps, one after the other, with independent heights.

Columns, in this order: x0 (n), u0, m, m c_r, m c_l, l where G integrates, the heights of the ramps
where u walks, m xi (K), and once more K for the size of the first jump of p, which depends on the
unknown start of p.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.estimation.regression.error_model import ErrorFilter, ErrorModel
from backlash_ros.core.estimation.regression.play import Labels
from backlash_ros.core.plant.filtering import lfilter
from backlash_ros.core.plant.state_model import StateModel

Array = NDArray[np.float64]

RAMPS = 12  # of a walk within a record
SIGNALS = 4  # that drive G: 1_H, v_a, -1_R, -1_L


def held(y: Array, before: float) -> Array:
    """y (N,) with what was lost replaced by the value before it."""
    finite = np.isfinite(y)
    if finite.all():
        return y
    known = np.where(finite, np.arange(len(y)), -1)
    np.maximum.accumulate(known, out=known)
    return np.where(known < 0, before, y[known])


@dataclass(frozen=True)
class Layout:
    """Where the unknowns stand.

    n: order of G. errors: K. leak, jump: whether a leak and the first jump are there. ramps: how
    many there are.
    """

    n: int
    errors: int
    leak: bool
    jump: bool
    ramps: int

    @cached_property
    def driven(self) -> int:
        """Number of unknowns that make the state of G without a walk: x0, u0, theta."""
        return self.n + 4

    @cached_property
    def walk(self) -> slice:
        """Heights of the ramps."""
        first = self.driven + int(self.leak)
        return slice(first, first + self.ramps)

    @cached_property
    def base(self) -> int:
        """Number of unknowns without those of the error model."""
        return self.driven + int(self.leak) + self.ramps

    @cached_property
    def theta(self) -> slice:
        """m, m c_r, m c_l."""
        return slice(self.n + 1, self.n + 4)

    @cached_property
    def error(self) -> slice:
        """m xi, but not those of the first jump."""
        return slice(self.base, self.base + self.errors)

    @cached_property
    def unknowns(self) -> int:
        """Number p of all unknowns."""
        return self.base + self.errors * (2 if self.jump else 1)


class Regressors:
    """Makes the columns for samples that come in pieces, one piece after the other.

    ramp: samples that each ramp of a walk takes, 0 where u does not walk.
    """

    def __init__(self, model: StateModel, error: ErrorModel, jump: bool, ramp: int = 0) -> None:
        n = model.order
        self.layout = Layout(
            n, error.count, error.leak > 0.0, jump and error.count > 0, RAMPS if ramp else 0
        )
        self._ramp, self._count = ramp, 0
        self._model, self._error = model, error
        transfer = model.transfer_function
        self._numerator, self._denominator = transfer.numerator, transfer.denominator
        # One filter for all: x0 are states, the others inputs. lfilter keeps the state of the
        # observer form.
        self._states: Array = np.zeros((n + SIGNALS + self.layout.ramps, n))
        self._states[:n] = model.to_observer.T
        self._errors = ErrorFilter(error, 2 if self.layout.jump else 1)
        self._sum = self._y = 0.0  # of all y so far, and the newest one

    def rows(self, labels: Labels, y: Array) -> Array:
        """Columns for the next samples, shape (N, p): how the outputs after them depend on all.

        y: measured after each of them, nan where lost, shape (N,).
        """
        layout, n, count = self.layout, self.layout.n, len(y)
        signals = np.zeros((len(self._states), count))
        signals[n], signals[n + 1] = labels.held, labels.v_a
        np.negative(labels.right, out=signals[n + 2])
        np.negative(labels.left, out=signals[n + 3])
        if layout.ramps:
            signals[n + SIGNALS:] = self.ramps(self._count, count)
        self._count += count
        answers, self._states = self._answers(signals, self._states)
        driven = layout.driven
        columns = np.empty((layout.unknowns, count))
        columns[:driven] = answers[:driven]
        if layout.leak:
            columns[driven] = self._leak(y)
        columns[layout.walk] = answers[n + SIGNALS:]
        if layout.errors:
            moves = np.array([labels.moves, labels.jump] if layout.jump else [labels.moves])
            responses = self._errors.responses(moves)
            columns[layout.base:] = responses.reshape(-1, count)
            # The prior of the error is around the G that was told.
            columns[n + 1] += self._error.told @ responses[0]
        return columns.T

    def begin_after(self, moves: Array) -> None:
        """Begin where the error of G still answers to these moves of p (N,), the newest last."""
        self._errors.responses(moves[None])

    def _answers(self, signals: Array, states: Array) -> tuple[Array, Array]:
        """Outputs of G after each sample of the signals (M, N), and its states after the last."""
        # A filter without direct feedthrough answers a sample late; its last state is the rest.
        late, after = lfilter(self._numerator, self._denominator, signals, zi=states)
        answers = np.empty_like(signals)
        answers[:, :-1], answers[:, -1] = late[:, 1:], after[:, 0]
        return answers, after

    def _leak(self, y: Array) -> Array:
        """Minus the sum of all y before, a lost one counting as the one before it."""
        filled = held(y, self._y)
        before: Array = np.concatenate([[self._sum + self._y], filled]).cumsum()
        self._sum, self._y = float(before[-2]), float(filled[-1])
        return -before[:-1]

    def ramps(self, first: int, count: int) -> Array:
        """The ramps over so many samples from number `first` on, shape (ramps, count)."""
        begins = self._ramp * np.arange(self.layout.ramps)[:, None]
        samples = np.arange(first + 1, first + count + 1)
        return np.asarray(np.clip((samples - begins) / max(self._ramp, 1), 0.0, 1.0))

    @property
    def heights(self) -> Array:
        """How far each ramp has risen after the samples so far, shape (ramps,)."""
        return self.ramps(self._count - 1, 1)[:, 0]

    def state_map(self) -> Array:
        """State of G after the samples so far in the coordinates of StateModel, shape (n, base).

        The error model has no part in it.
        """
        layout, to_state = self.layout, self._model.to_state
        by = np.zeros((layout.n, layout.base))
        by[:, :layout.driven] = to_state @ self._states[:layout.driven].T
        by[:, layout.walk] = to_state @ self._states[layout.n + SIGNALS:].T
        return by
