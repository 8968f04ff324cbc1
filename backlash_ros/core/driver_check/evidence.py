"""What messages and motion of a driver come to, each worked out once it is asked for.

The whole record is fitted at once, by the fit of the loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check.heard import (
    Graph,
    Heard,
    Message,
    Timing,
    stamps_of,
    timing_of,
)
from backlash_ros.core.driver_check.record_fit import RecordFit, fit_record
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.loop.command_history import ReportUse, report_use, v_of_intervals
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.records.readings import own_readings

Array = NDArray[np.float64]

DECISIVE = 3.0  # log-likelihood by which one delay beats another
WELL_PREDICTED = 0.9  # share of the motion of y that G has to predict
MORE_DELAY = 8  # samples that are tried beyond the expected delay


@dataclass(frozen=True)
class Evidence:
    """graph, heard: of the driver. p: parameters of the controller."""

    graph: Graph
    heard: Heard
    p: Parameters

    @cached_property
    def timing(self) -> Timing:
        """Its samples."""
        return timing_of(self.heard, self.p.sample_period)

    @property
    def age_s(self) -> float:
        """Time from the stamp of a sample to its arrival, in the middle."""
        return 1e-9 * float(np.median([m.received_ns - m.stamp_ns for m in self.timing.outputs]))

    @property
    def implausible(self) -> str:
        """How many values on which topic are no numbers of a machine."""
        counts = {topic: sum(not plausible(message.value) for message in messages)
                  for topic, messages in (('plant_output', self.heard.outputs),
                                          ('control', self.heard.controls),
                                          ('applied_control', self.heard.applied))}
        return ', '.join(f'{count} on {topic}' for topic, count in counts.items() if count)

    @cached_property
    def sensor_period(self) -> float:
        """Of a sensor that is slower than the driver [s], 0 where none is."""
        y = np.array([message.value for message in self.timing.outputs])
        return own_readings(self.timing.period_s * self.timing.numbers.astype(float), y)[1]

    # --- v

    @cached_property
    def control(self) -> Array | None:
        """v of control over each sample interval (N,), nan before any; None where there is none."""
        return self._over(self.heard.controls, False)

    @cached_property
    def applied(self) -> Array | None:
        """The same of applied_control."""
        return self._over(self.heard.applied, True)

    @cached_property
    def v(self) -> Array | None:
        """The v that acted, as far as it is known."""
        return self.control if self.applied is None else self.applied

    @property
    def swing(self) -> float:
        """Of v."""
        return 0.0 if self.v is None else float(np.nanmax(self.v) - np.nanmin(self.v))

    @cached_property
    def lag(self) -> int:
        """Samples by which applied_control follows control."""
        return int(np.argmin([self._apart(lag).mean() for lag in range(MORE_DELAY + 1)]))

    @cached_property
    def limited_by(self) -> float:
        """What applied_control differs by from control at most; 0 where the driver limits nothing.

        What differs by more than 2 % of the swing was limited, but for 5 % of the samples.
        """
        if self.applied is None or self.control is None:
            return 0.0
        apart = self._apart(self.lag)
        swing = float(np.nanmax(self.control) - np.nanmin(self.control))
        return float(apart.max()) if np.mean(apart > 0.02 * swing) > 0.05 else 0.0

    def _apart(self, lag: int) -> Array:
        if self.applied is None or self.control is None:
            return np.zeros(1)
        apart = np.abs(self.applied[lag:] - self.control[:len(self.control) - lag])
        return apart[np.isfinite(apart)] if np.isfinite(apart).any() else np.full(1, inf)

    def _over(self, messages: list[Message], reported: bool) -> Array | None:
        usable = [message for message in messages if plausible(message.value)]
        if not usable or not self.timing.outputs:
            return None
        v = v_of_intervals(
            self.timing.numbers, stamps_of(self.timing.outputs), stamps_of(usable),
            np.array([message.value for message in usable]), reported)
        return v if np.isfinite(v).any() else None

    # --- v and y

    @cached_property
    def record(self) -> tuple[Array, Array]:
        """v from sample k to k+1 and y at k, nan where lost, from the first known v on."""
        assert self.v is not None
        y = np.full(len(self.v), nan)
        y[self.timing.numbers] = [
            m.value if plausible(m.value) else nan for m in self.timing.outputs]
        known = int(np.argmax(np.isfinite(self.v)))
        return self.v[known:], y[known:]

    @cached_property
    def fit(self) -> RecordFit:
        """With any delay that the driver may have."""
        model = TransferFunction(self.p.plant.numerator, self.p.plant.denominator)
        expected = self.p.control.delay_samples
        return self._fitted(model, range(expected + MORE_DELAY + 1))

    @property
    def best(self) -> WindowFit:
        """The values of the fit, where there is one."""
        assert self.fit.fit is not None
        return self.fit.fit

    def _fitted(self, model: TransferFunction, delays: range, skipped: int = 0) -> RecordFit:
        v, y = self.record
        return fit_record(v[skipped:], y[skipped:], model, self.p.plant.uncertainty,
                          self.p.estimator.output_noise_std, delays=delays)

    @property
    def delay(self) -> int:
        """From control to y [samples], beyond that of G; from the report where that counts."""
        # A report that counts already has the lag.
        counts = report_use(self.p) is ReportUse.ALWAYS
        return self.fit.delay + (0 if counts or self.applied is None else self.lag)

    @property
    def delay_is_another(self) -> bool:
        """Whether it is not the one of the parameters."""
        told = self.p.control.delay_samples - self.delay + self.fit.delay
        return self.fit.margins.get(told, inf) > DECISIVE

    @property
    def noisy(self) -> bool:
        """Whether y is noisier than it should be, by more than a guess may be off."""
        return self.best.noise > 3.0 * self.p.estimator.output_noise_std

    @property
    def coloured(self) -> bool:
        """Whether successive residuals are alike as those of the noise of a sensor are not."""
        return self.best.correlation > 0.5

    @property
    def unlike(self) -> bool:
        """Whether y does not follow G."""
        # A delay that nobody announced together with what is not noise is an odd G as well.
        odd = self.noisy and self.coloured and self.delay_is_another
        return self.fit.predicted < WELL_PREDICTED or odd

    @property
    def outside(self) -> str:
        """Which estimate lies outside of its bounds; only m counts while the others are not known.
        """
        for name, (value, std) in list(self.fit.estimates.items())[:1 if self.fit.doubts else 3]:
            low, high = getattr(self.p.estimator.bounds, name)
            slack = 3.0 * std + 0.01 * abs(value)
            if not low - slack <= value <= high + slack:
                return f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]'
        return ''

    @cached_property
    def other_period(self) -> float | None:
        """Sample period [s] for which the poles of G fit better by far; None where there is none.
        """
        if not self.unlike and self.best.scale <= 2.0:
            return None
        nominal, evidence = self.fit.nominal, self.best.evidence
        others: list[tuple[float, float, float]] = []
        for ratio in (0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 20.0):
            denominator = np.real(np.poly(nominal.poles.astype(complex) ** ratio)).tolist()
            # The same samples of y as in the fit, whose evidence is compared.
            expected = self.p.control.delay_samples
            refit = self._fitted(TransferFunction(nominal.numerator.tolist(), denominator),
                                 range(expected, expected + 1), MORE_DELAY)
            # The zeros are still those of the other period: G may be off by more, if it explains
            # more.
            if refit.fit is not None and refit.predicted >= WELL_PREDICTED and (
                    refit.fit.scale <= 1.0 or refit.fit.evidence > evidence + DECISIVE):
                others.append((refit.fit.evidence, refit.fit.scale, ratio))
        most = max((other[0] for other in others), default=-inf)
        if most <= evidence - DECISIVE:
            return None
        # Of those that fit alike the one that is least off.
        _, ratio = min(other[1:] for other in others if other[0] > most - 10.0)
        return self.p.sample_period / ratio
