"""Which structure is taken, and the deviations of what is fitted to it."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from records import moves_with_rests
from scipy.signal import lfilter

from backlash_ros.core.control.motion import strokes
from backlash_ros.core.estimation.posterior import WindowFit
from backlash_ros.core.identification import model as models
from backlash_ros.core.identification import structure_search as search
from backlash_ros.core.identification.identification import identify
from backlash_ros.core.judgement.deviations import by_model, covariance_of
from backlash_ros.core.plant.backlash import play

STILL, SWUNG = (models.Samples(v, np.full(len(v), np.nan), 1, len(v), 0.0, models.Units())
                for v in (np.zeros(2), np.sin(0.1 * np.arange(300.0))))
# Strokes, what a play makes of them, and noise.
V = np.array(list(islice(strokes(-2.0, 2.0, 8.0, 0.02, 20.0, 0.0), 1000)))
U = play(V, 0.4, 0.2) - 0.1
NOISE = 0.002 * np.random.default_rng(8).standard_normal(1000)


def model_of(
    integrator: bool, poles: list[complex], zeros: list[complex], samples: models.Samples = STILL,
) -> models.Model:
    structure = models.Structure(len(poles) + integrator, 0, integrator)
    a = np.real(np.poly(poles))[1:] if poles else np.empty(0)
    b = np.zeros(structure.numerator_taps)
    b[len(b) - 1 - len(zeros):] = np.real(np.poly(zeros))
    theta = np.concatenate([[1.0, 0.0, 1.0], structure.xi(b, a)])
    fit = WindowFit(np.zeros(1), 0.0, theta, 1.0)
    return models.Model(structure, samples.problem(structure), fit)


def compared(model: models.Model, held_out: float, criterion: float) -> search.Compared:
    return search.Compared(model.structure, held_out, model, model, criterion)


PLAIN = compared(model_of(False, [0.6 + 0.4j, 0.6 - 0.4j], [-0.8]), 1.2, -20.0)
NO_INTEGRATOR = compared(model_of(True, [0.6 + 0.4j, 0.6 - 0.4j], [-0.8, 1.0]), 1.1, -30.0)
NEITHER = compared(model_of(True, [0.98, 0.6 + 0.4j, 0.6 - 0.4j], [-0.8, 1.0, 0.98]), 1.0, -40.0)


@pytest.mark.parametrize(('integrator', 'poles', 'zeros', 'cancelled'), [
    (True, [0.9], [1.0 + 1e-4], [1.0]), (True, [0.9], [1.0 - 1e-3], []),
    (True, [0.9], [0.9], [0.9]), (False, [0.9, 0.5], [0.901], [0.9]),
    (False, [0.9, 0.5], [0.91], []), (True, [0.9, 0.5], [1.0, 0.5], [0.5, 1.0]),
    (False, [0.5, 0.6 + 0.4j, 0.6 - 0.4j], [0.6 + 0.4j, 0.6 - 0.4j], [0.6 + 0.4j, 0.6 - 0.4j]),
    (True, [], [], []), (False, [0.9, 0.5], [], []),
])
def test_a_pole_with_a_zero_on_it_is_cancelled(integrator, poles, zeros, cancelled):
    assert search.cancelled_poles(model_of(integrator, poles, zeros)) == pytest.approx(cancelled)


def test_a_cancelled_pole_gives_way_however_well_it_predicts() -> None:
    assert search.selected([PLAIN, NO_INTEGRATOR, NEITHER]) is PLAIN
    # The structure without the slow pole is not needed either, nor the one without the integrator.
    slow = compared(model_of(False, [0.98, 0.6 + 0.4j, 0.6 - 0.4j], [-0.8, 0.98]), 1.05, -35.0)
    assert search.selected([PLAIN, NO_INTEGRATOR, slow, NEITHER]) is PLAIN


def test_it_gives_way_to_nothing_else_than_the_structure_without_it() -> None:
    assert search.gives_way(NO_INTEGRATOR.whole, [PLAIN])
    assert not search.gives_way(PLAIN.whole, [PLAIN])
    assert not search.gives_way(NEITHER.whole, [PLAIN, NEITHER])
    assert search.selected([PLAIN, NEITHER]) is NEITHER
    later = PLAIN._replace(structure=replace(PLAIN.structure, delay=1))
    assert not search.gives_way(NO_INTEGRATOR.whole, [later, NO_INTEGRATOR])


@pytest.mark.parametrize('odd', [
    model_of(False, [0.5, -0.5], [0.1]), model_of(True, [0.5], [0.9999], SWUNG)])
def test_what_stands_in_for_half_a_sample_or_for_a_drift_is_taken_only_where_all_do(odd) -> None:
    plain, better = compared(model_of(False, [0.6], []), 1.2, -20.0), compared(odd, 0.5, -90.0)
    assert search.selected([plain, better]) is plain
    assert search.selected([better]) is better


def test_a_gain_and_a_delay_have_no_poles_and_can_be_controlled() -> None:
    y = np.append(np.zeros(3), 1.7 * U[:-3]) + NOISE
    found = identify(V, y, 0.02, search.Options((0, 1), (1, 2, 3)))
    assert found.usable
    assert (found.model.delay, found.model.denominator) == (2, (1.0, 0.0))
    assert found.model.numerator == pytest.approx((1.7,), abs=0.01)
    assert found.gap == pytest.approx(0.4, abs=3.0 * found.std['gap'])
    # A delay that may be longer than all that were compared is no narrow gap.
    edge = identify(V, y, 0.02, search.Options((0,), (0, 1)))
    assert edge.std['gap'] > abs(edge.gap - 0.4) > 0.05
    assert any('longest that was compared' in text for text in edge.remarks)


def test_a_delay_beyond_those_that_are_compared_first_is_found() -> None:
    y = lfilter([0.0, 0.3], [1.0, -0.7], np.append(np.zeros(12), U[:-12])) + NOISE
    found = identify(V, y, 0.02, search.Options((1, 2)))
    assert found.model.delay == 12
    assert found.gap == pytest.approx(0.4, abs=4.0 * found.std['gap'])
    assert found.std['gap'] < 0.01


def std_of_gap(noise: np.ndarray) -> tuple[float, float]:
    v = np.sin(0.05 * np.arange(len(noise)))
    y = lfilter([0.0, 0.3], [1.0, -0.7], play(v, 0.3, 0.1)) + noise
    samples = models.Samples(v, y, 1, len(v), 0.0, models.Units())
    structure = models.Structure(1, 0, False)
    found = models.fitted(samples, structure, models.first_model(samples, structure, 0.25, 0.1).fit)
    matrix = covariance_of(found.problem, found.fit)
    return matrix[2, 2] ** 0.5, found.fit.cov[2, 2] ** 0.5


def test_noise_that_lasts_leaves_a_wider_gap_than_white_noise() -> None:
    white = 0.01 * np.random.default_rng(1).standard_normal(1500)
    own, posterior = std_of_gap(white)
    assert own == pytest.approx(posterior, rel=0.5)
    own, posterior = std_of_gap(lfilter([0.3], [1.0, -0.9], white))
    assert own > 1.5 * posterior


def test_models_that_fit_alike_tell_a_deviation_and_others_none() -> None:
    assert by_model(1.0, [(1.2, -3.0), (1.3, 4.0), (9.0, 4.1)]) == pytest.approx(0.2)
    assert by_model(1.0, []) == 0.0


def test_a_fit_that_leaves_more_than_y_itself_is_taken_only_where_all_do() -> None:
    v = np.zeros(50)
    samples = models.Samples(v, np.sin(np.arange(50.0)), 1, 50, 0.0, models.Units())
    structures = [models.Structure(0, 0, False), models.Structure(1, 0, False)]
    still, off = (models.Model(one, samples.problem(one), WindowFit(
        np.zeros(1), 0.0, np.concatenate([[1.0, offset, 1.0], one.xi(np.ones(1), np.zeros(
            one.free_poles))]), 1.0)) for one, offset in zip(structures, (0.0, 9.0), strict=True))
    good, bad = compared(still, 1.0, -10.0), compared(off, 0.1, 50.0)
    assert search.selected([good, bad]) is good
    assert search.selected([bad]) is bad


def gaps_of_moves_with_rests(noise: float, seed: int) -> tuple[float, float, float]:
    """Quantization step that counts, and the gap by a fit without and with it; noise in steps."""
    rng, step = np.random.default_rng(seed), 0.004
    v = moves_with_rests(rng.uniform(-6.0, 6.0, 8), 0.008, 800)
    y = lfilter([0.0, 0.05], [1.0, -0.95], play(v, 0.9, 0.45) - 0.5)
    y = step * np.round(y / step + noise * rng.standard_normal(len(v)))
    samples = models.Samples(v, y, 1, len(v), 0.0, models.Units())
    structure = models.Structure(1, 0, False)
    found = models.fitted(samples, structure, models.first_model(samples, structure, 0.8, 0.4).fit)
    kept = search.cleaned(samples, found)
    return kept.step, found.gap, models.fitted(kept, structure, found.fit).gap


def test_the_readings_of_a_rest_share_one_rounding_unless_noise_hides_it() -> None:
    steps, without, weighed = np.transpose([gaps_of_moves_with_rests(0.05, k) for k in range(4)])
    assert steps == pytest.approx(0.004)
    assert np.abs(weighed - 0.9).mean() < 0.3 * np.abs(without - 0.9).mean() < 3e-4
    assert gaps_of_moves_with_rests(2.0, 0)[0] == 0.0
