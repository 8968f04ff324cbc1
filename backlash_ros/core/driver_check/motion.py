"""What the motion of a driver says: delay, sign, G(z), noise, and whether the backlash shows.

Pure: no ROS in here. The whole record is fitted at once, by the fit of the loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isnan, nan, pi

import numpy as np
from numpy.typing import NDArray

from backlash_ros.core.control.limits import plausible
from backlash_ros.core.driver_check.findings import (
    FITS,
    UNKNOWN,
    WRONG,
    Finding,
    Heard,
    Message,
    Timing,
)
from backlash_ros.core.driver_check.record_fit import RecordFit, fit_record
from backlash_ros.core.identification.verdict import SHOWS
from backlash_ros.core.loop.command_history import REPORTED, ReportUse, report_use, v_of_intervals
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction

Array = NDArray[np.float64]

DELAY, SIGN, MODEL, NOISE, BACKLASH = (
    'reaction delay', 'sign and units', 'G(z)', 'noise on y', 'backlash',
)
MOTION_SUBJECTS = (DELAY, SIGN, MODEL, NOISE, BACKLASH)

DECISIVE = 3.0  # log-likelihood by which one delay beats another
SURE = 10.0  # log-likelihood by which one sample period beats another
PREDICTED = 0.9  # share of the motion of y that G has to predict
BOUND_SLACK = 0.01  # of a value that lies outside its bounds without harm
NOISIER = 3.0  # times the given deviation of the noise
COLOURED = 0.5  # correlation of successive residuals that noise of a sensor does not have
OTHER_PERIODS = (0.05, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 20.0)  # times T, tried for G
ALTERED = 0.02  # of the swing of v: applied_control that differs by more was limited
ALTERED_SHARE = 0.05  # of the samples
MORE_DELAY = 8  # samples that are tried beyond the expected delay
FAR = 2.0  # times plant.uncertainty; an error of G beyond may be that of its sample period


@dataclass
class Record:
    """v (N,) from sample k to k+1, y (N,) with nan where lost, and what v was taken from.

    lag: samples from control to applied_control; 0 where v is that of control.
    """

    v: Array
    y: Array
    lag: int


def applied_findings(heard: Heard, timing: Timing, p: Parameters) -> list[Finding]:
    """Whether applied_control, where it is published or asked for, is of use."""
    use = report_use(p)
    wanted = use is ReportUse.ALWAYS
    subject = 'applied_control'
    if not heard.applied:
        return [Finding(
            subject, WRONG, 'is not published',
            'report v just before each y, or set estimator.use_applied_control: false',
        )] if wanted else []
    share = len(heard.applied) / len(timing.outputs)
    if use is not ReportUse.NEVER and share < REPORTED:
        return [Finding(
            subject, WRONG, f'comes with {share:.0%} of the samples',
            'report v just before each y, or set estimator.use_applied_control: false',
        )]
    applied = _on_grid(heard.applied, timing)
    control = _on_grid(heard.controls, timing)
    if use is not ReportUse.NEVER or control is None or applied is None:
        return [Finding(subject, FITS, 'is published')]
    moved = _shifted_difference(applied, control, _lag(applied, control))
    swing = float(np.ptp(control))
    if np.mean(moved > ALTERED * swing) > ALTERED_SHARE:
        return [Finding(
            subject, WRONG, f'differs from control by up to {moved.max():.3g}',
            'set estimator.use_applied_control: true, or narrow control.min, max, rate_max',
        )]
    return [Finding(subject, FITS, 'agrees with control')]


def record_of(heard: Heard, timing: Timing) -> Record | None:
    """v and y sample by sample, from the first known v on; None where no v was heard."""
    v = _on_grid(heard.applied or heard.controls, timing, reported=bool(heard.applied))
    if v is None:
        return None
    y = np.full(len(v), nan)
    values = np.array([m.value if plausible(m.value) else nan for m in timing.outputs])
    y[timing.index] = values
    lag = 0
    if heard.applied:
        control = _on_grid(heard.controls, timing)
        lag = 0 if control is None else _lag(v, control)
    known = int(np.argmax(np.isfinite(v)))
    return Record(v[known:], y[known:], lag)


def _on_grid(messages: list[Message], timing: Timing, reported: bool = False) -> Array | None:
    """v over each sample interval, shape (N,); nan before any. reported: it is that which acted."""
    usable = [message for message in messages if plausible(message.value)]
    if not usable:
        return None
    v = v_of_intervals(
        timing.index.astype(np.int64), _stamps(timing.outputs), _stamps(usable),
        np.array([message.value for message in usable]), reported,
    )
    return v if np.isfinite(v).any() else None


def _stamps(messages: list[Message]) -> NDArray[np.int64]:
    return np.array([message.stamp_ns for message in messages], dtype=np.int64)


def _lag(applied: Array, control: Array) -> int:
    """Samples by which applied follows control."""
    return int(np.argmin([
        _shifted_difference(applied, control, lag).mean() for lag in range(MORE_DELAY + 1)
    ]))


def _shifted_difference(applied: Array, control: Array, lag: int) -> Array:
    difference = np.abs(applied[lag:] - control[: len(control) - lag])
    known = difference[np.isfinite(difference)]
    return known if len(known) else np.full(1, np.inf)


def motion_findings(record: Record | None, p: Parameters) -> list[Finding]:
    """What v and y say together."""
    swing = 0.0 if record is None else float(np.ptp(record.v))
    if record is None or swing == 0.0:
        return _only(BACKLASH, 'v stood still', 'run the controller, or check_driver --drive')
    model = TransferFunction(p.plant.numerator, p.plant.denominator)
    fit = _fit(model, record, p)
    if isnan(fit.evidence):
        return _only(
            BACKLASH, f'too few samples after v had swung by {swing:.4g}', 'raise --duration'
        )
    if fit.evidence < SHOWS:
        return _only(
            BACKLASH, f'y shows nothing of v, which swung by {swing:.4g}',
            'let v swing wider than the gap; see that the driver applies v',
        )
    if fit.reversals == 0 and fit.predicted >= PREDICTED:
        # Without a turn of the play, lag and delay take up what the gap does.
        return _only(
            BACKLASH, f'not identifiable from this motion: v swung by {swing:.4g} on one side',
            'swing v past the gap in both directions, several times; raise --duration',
        )
    unlike = fit.predicted < PREDICTED or _odd(fit, record.lag, p)
    if unlike or fit.error_scale > FAR:
        other = _other_period(fit, record, p)
        if unlike or other is not None:
            return _only(MODEL, *_mismatch(fit, other, p))
    return [
        _delay(fit, record.lag, p), _sign(fit, p), _model(fit, p), _noise(fit, p),
        _backlash(fit, swing),
    ]


def _fit(
    model: TransferFunction, record: Record, p: Parameters, more_delay: int = MORE_DELAY,
) -> RecordFit:
    """Fit with any delay that the driver may have, or with the expected one alone."""
    expected = p.control.delay_samples
    return fit_record(
        record.v, record.y, model, p.plant.uncertainty,
        p.estimator.output_noise_std,
        delays=range(expected + more_delay + 1) if more_delay else (expected,),
    )


def _only(subject: str, found: str, cure: str) -> list[Finding]:
    """One reason why nothing else can be told."""
    return [Finding(subject, WRONG, found, cure)] + [
        not_judged(other, f'once {subject} fits') for other in MOTION_SUBJECTS if other != subject
    ]


def not_judged(subject: str, when: str) -> Finding:
    """A line for what something else hides."""
    return Finding(subject, UNKNOWN, f'can be told {when}')


def _odd(fit: RecordFit, lag: int, p: Parameters) -> bool:
    """Whether a delay that nobody announced came out together with what is not noise."""
    noisy = fit.noise_std > NOISIER * p.estimator.output_noise_std
    return noisy and fit.correlation > COLOURED and _delay(fit, lag, p).mark == WRONG


def _mismatch(fit: RecordFit, other: float | None, p: Parameters) -> tuple[str, str]:
    """Say how badly G predicts y, and whether the same poles at another period [s] would."""
    period = p.sample_period
    if other is not None:
        return f'is off by far, and less so for a sample period of {other:.3g} s', (
            f'G(z) looks made for a sample period of about {other:.3g} s: discretise it with '
            f'sample_period, {period:g} s'
        )
    return f'predicts {max(fit.predicted, 0.0):.0%} of the motion of y', (
        'enter the G(z) of this plant, discretised with sample_period; see that y is measured '
        'behind the gap and that the driver holds v over the period'
    )


def _other_period(fit: RecordFit, record: Record, p: Parameters) -> float | None:
    """Sample period [s] for which the poles of G fit to within plant.uncertainty, or far better."""
    later = Record(record.v[MORE_DELAY:], record.y[MORE_DELAY:], record.lag)
    others: list[tuple[float, float, float]] = []
    for ratio in OTHER_PERIODS:
        denominator = np.real(np.poly(fit.nominal.poles.astype(complex) ** ratio)).tolist()
        other = TransferFunction(fit.nominal.numerator.tolist(), denominator)
        # The same samples of y as in the fit, whose evidence is compared.
        refit = _fit(other, later, p, more_delay=0)
        # The zeros are still those of the other period: G may be off by more, if it explains more.
        fits = refit.error_scale <= 1.0 or refit.evidence > fit.evidence + DECISIVE
        if refit.predicted >= PREDICTED and fits:
            others.append((refit.evidence, refit.error_scale, ratio))
    best = max((evidence for evidence, _, _ in others), default=-inf)
    if best <= fit.evidence - DECISIVE:
        return None
    # Of those that fit alike the one that is least off.
    _, ratio = min(other[1:] for other in others if other[0] > best - SURE)
    return p.sample_period / ratio


def _delay(fit: RecordFit, lag: int, p: Parameters) -> Finding:
    expected = p.control.delay_samples
    if report_use(p) is ReportUse.ALWAYS:
        lag = 0  # the report already has it
    found = fit.delay + lag
    if fit.margins.get(expected - lag, inf) <= DECISIVE:
        return Finding(DELAY, FITS, f'{expected} samples, as control.delay_samples says')
    return Finding(
        DELAY, WRONG, f'{found} samples; control.delay_samples says {expected}',
        f'apply v as soon as it comes, or set control.delay_samples: {found}',
    )


def _sign(fit: RecordFit, p: Parameters) -> Finding:
    if fit.m < 0.0:
        return Finding(
            SIGN, WRONG, f'y moves against v: m would be {fit.m:.4g}',
            'change the sign of y or v in the driver, or of plant.numerator',
        )
    values = [('m', fit.m, fit.std_m)]
    if not fit.doubts:
        values += [('c_r', fit.c_r, fit.std_c_r), ('c_l', fit.c_l, fit.std_c_l)]
    for name, value, std in values:
        low, high = getattr(p.estimator.bounds, name)
        slack = 3.0 * std + BOUND_SLACK * abs(value)
        if not low - slack <= value <= high + slack:
            return Finding(
                SIGN, WRONG, f'{name} would be {value:.4g}, outside [{low:g}, {high:g}]',
                f'see the units of v, y and G(z) and the zero of v, or widen '
                f'estimator.bounds.{name}',
            )
    return Finding(SIGN, FITS, f'm is about {fit.m:.4g}, within its bounds')


def _model(fit: RecordFit, p: Parameters) -> Finding:
    """Say how far G is off where it was learned to be another one: the loop learns it too."""
    found = f'predicts {fit.predicted:.1%} of the motion of y'
    if fit.model is not fit.nominal:
        period = p.sample_period
        errors = ', '.join(
            f'{error:.1%} at {frequency / (2.0 * pi * period):.2g} Hz'
            for frequency, error in zip(
                fit.frequencies, fit.error_of_model(fit.frequencies), strict=True
            )
        )
        found += f' once it is corrected: it is off by {errors}'
    return Finding(MODEL, FITS, found)


def _noise(fit: RecordFit, p: Parameters) -> Finding:
    given = p.estimator.output_noise_std
    found = f'deviation {fit.noise_std:.2g}; estimator.output_noise_std says {given:.2g}'
    if fit.noise_std <= NOISIER * given:
        return Finding(NOISE, FITS, found)
    cure = f'set estimator.output_noise_std: {fit.noise_std:.1e}'
    if fit.correlation > COLOURED:
        cure += ', or give a more exact G(z): the residual is coloured'
    return Finding(NOISE, WRONG, found, cure)


def _backlash(fit: RecordFit, swing: float) -> Finding:
    if fit.doubts:
        return Finding(
            BACKLASH, WRONG, f'not identifiable from this motion: v swung by {swing:.4g}; '
            + '; '.join(fit.doubts),
            'swing v past the gap in both directions, several times; raise --duration',
        )
    return Finding(BACKLASH, FITS, ', '.join(
        f'{name} = {value:.4g} ± {std:.1g}' for name, value, std in (
            ('m', fit.m, fit.std_m), ('c_r', fit.c_r, fit.std_c_r), ('c_l', fit.c_l, fit.std_c_l),
        )
    ))
