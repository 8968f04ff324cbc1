"""Parts of the fit on their own: the family of G(z; xi), readings, the search, the observer."""

import numpy as np
import pytest
from records import moves_with_rests, resonance, two_poles
from scipy.optimize import least_squares
from strategies import PAPER_DENOMINATOR, PAPER_NUMERATOR

from backlash_ros.core.estimation.explanations import Setup, afresh
from backlash_ros.core.estimation.fit import FEW_STEPS, Problem
from backlash_ros.core.estimation.plant_family import PlantFamily
from backlash_ros.core.estimation.posterior import WindowFit, error_of_plant
from backlash_ros.core.estimation.search import search
from backlash_ros.core.parameters import Bounds, Parameters
from backlash_ros.core.plant.backlash import play
from backlash_ros.core.plant.numerics import RATIOS, gain_of, lfilter
from backlash_ros.core.plant.quantized import independence, likelihood
from backlash_ros.core.plant.simulated_plant import altered_plant
from backlash_ros.core.plant.transfer_function import StateModel, TransferFunction
from backlash_ros.core.window import Window

PLANTS = {
    'one pole': ([0.3], [1.0, -0.7]), 'integrator': ([0.1], [1.0, -1.7, 0.7]),
    'three poles': ([0.2, 0.1, 0.02], [1.0, -1.2, 0.4, -0.03]),
    'delayed, real poles': ([0.1, 0.05], [1.0, -1.3, 0.4, 0.0]),
}


@pytest.mark.parametrize('plant', PLANTS.values(), ids=PLANTS)
def test_slopes_are_those_of_the_coefficients(plant: tuple[list[float], list[float]]) -> None:
    family, step = PlantFamily(TransferFunction(*plant), 0.2), 1e-6
    xi = np.linspace(0.3, -0.4, family.count)
    for slopes in zip(*family.slopes(xi.tolist()), strict=True):
        assert all(np.isfinite(part).all() for part in slopes)
    for j, (db, da) in enumerate(zip(*family.slopes(xi.tolist()), strict=True)):
        ahead, behind = (family.at((xi + sign * step * np.eye(len(xi))[j]).tolist())
                         for sign in (1.0, -1.0))
        for slope, above, below in zip((db, da), ahead, behind, strict=True):
            found = (np.array(above) - below) / (2.0 * step)
            np.testing.assert_allclose(slope[:len(found)], found, atol=1e-8)


@pytest.mark.parametrize('far', [-1e3, 1e3])
def test_coefficients_are_finite_however_far_a_fit_strays(far: float) -> None:
    family = PlantFamily(TransferFunction([0.5, 0.3], [1.0, -0.49, 0.016]), 0.2)
    xi = np.full(family.count, far).tolist()
    b, a = family.at(xi)
    assert sum(b) / sum(a) == pytest.approx(0.8 / 0.526)
    assert np.abs(np.roots(a)).max() <= 1.0
    assert all(np.isfinite(slopes).all() for slopes in family.slopes(xi))


def test_no_response_is_wider_than_an_average_over_five_samples() -> None:
    family = PlantFamily(TransferFunction([1.0], [1.0, 0.0]), 0.2)
    taps = []
    for width in (8.0, 1e3):
        b, _ = family.at([0.0, width])
        taps.append(b)
        k = np.arange(len(b))
        assert np.dot(b, k**2) - np.dot(b, k) ** 2 == pytest.approx(np.var(np.arange(5)))
    assert taps[0] == taps[1]


@pytest.mark.parametrize('omega_t', [0.13, 1.0, 2.5])
@pytest.mark.parametrize(
    ('lag', 'most'), [(0.0, 1e-6), (0.3, 1e-6), (1.0, 1e-6), (2.6, 1e-6), (0.96, 1e-2)])
def test_dead_time_and_another_frequency_are_among_them(
    omega_t: float, lag: float, most: float,
) -> None:
    family = PlantFamily(two_poles(omega_t), 0.2)
    true = altered_plant(two_poles(omega_t), 0.9, 1.0, lag)
    z = np.exp(1j * np.linspace(0.05, 3.0, 60))
    def apart(xi: np.ndarray) -> np.ndarray:
        off = family.model_at(xi.tolist()).response(z) - true.response(z)
        return np.concatenate([off.real, off.imag])
    begins = [[(lag + by) / family._scales[0][0], 0.0, 0.0, 0.0] for by in (-0.2, 0.1, 0.2)]
    assert min(abs(least_squares(apart, begin).fun).max() for begin in begins) < most


SCALED = {
    **PLANTS, 'zero near the poles': ([0.3, -0.27], [1.0, -1.8, 0.85]),
    'integrator and zeros': ([0.2, 0.1, -0.05], [1.0, -2.5, 2.06, -0.56]),
    'equal poles': ([0.02, 0.01], [1.0, -1.6, 0.64]),
    'late': ([0.01], [1.0, -2.4, 1.94, -0.532, 0.0, 0.0]),
    'two pairs of equal poles': ([0.02, 0.01, 0.02], np.poly([0.5, 0.5, 0.8, 0.8]).tolist()),
}


@pytest.mark.parametrize('faster', [0.6, 0.87, 1.15, 1.7])
@pytest.mark.parametrize('plant', SCALED.values(), ids=SCALED)
def test_zeros_move_with_the_poles_of_a_faster_plant(
    plant: tuple[list[float], list[float]], faster: float,
) -> None:
    model = TransferFunction(*plant)
    family, z = PlantFamily(model, 1.0), np.exp(1j * np.linspace(0.05, 3.0, 60))
    poles = [pole for pole in model.poles if 1e-6 < abs(pole) < 1.0 - 1e-6]
    pairs = len(poles) // 2
    moved = [np.log(faster), 0.0] * pairs + [np.log(faster)] * (len(poles) % 2)
    xi = [*[0.0] * (family.leaks + 2), *moved]
    true = altered_plant(model, faster).response(z)
    assert np.abs(family.model_at(xi).response(z) - true).max() < 1e-5 * np.abs(true).max()


def test_zeros_stay_where_no_continuous_plant_has_such_poles() -> None:
    family = PlantFamily(TransferFunction([0.2, 0.1], [1.0, -0.4, -0.21]), 1.0)  # 0.7, -0.3
    b, _ = family.at([0.0, 0.0, 0.3])
    assert b[1] / b[0] == pytest.approx(0.5)


@pytest.mark.parametrize('plant', PLANTS.values(), ids=PLANTS)
def test_the_response_is_continuous_around_lags_of_whole_samples(
    plant: tuple[list[float], list[float]],
) -> None:
    family, by = PlantFamily(TransferFunction(*plant), 0.2), 1e-7
    z = np.exp(1j * np.linspace(0.05, 3.0, 60))

    def response(lag: float) -> np.ndarray:
        xi = np.full(family.count, 0.4)
        xi[family.leaks] = lag / family._scales[family.leaks][0]
        return family.model_at(xi.tolist()).response(z)

    for lag in (-0.04, 0.0, 0.9, 0.97, 1.0, 1.94, 2.0):
        np.testing.assert_allclose(response(lag + by), response(lag - by), rtol=1e-4)


APART = 1e-3
R = APART * np.arange(-12_000, 12_001)


@pytest.mark.parametrize(('noise', 'step'), [(0.3, 0.0), (0.3, 1.0), (1.0, 1.0)])
def test_density_slope_and_information_belong_together(noise: float, step: float) -> None:
    near = np.abs(R) < 4.0 * noise
    found = likelihood(R, noise, step, near.astype(float))
    density = np.exp(found.log_density)
    assert density.sum() * APART == pytest.approx(1.0, rel=1e-6)
    by_output = -np.gradient(found.log_density, R)
    assert found.score[near] == pytest.approx(by_output[near], abs=1e-3)
    curvature = np.gradient(found.score, R)[near].sum()
    assert found.information[near].sum() == pytest.approx(curvature, rel=1e-3)


@pytest.mark.parametrize(('period', 'told'), [(60, False), (61.8, True)])
def test_dropped_readings_whose_rounding_is_repeated_say_nothing(period: float, told: bool) -> None:
    v = 3.0 * np.sin(2.0 * np.pi * np.arange(240) / period)
    family = PlantFamily(TransferFunction([0.3], [1.0, -0.7]), 0.0)
    b, a = family.at([])
    y = 0.05 * np.round(lfilter(b, a, play(v, 1.0, 0.5) - 0.5) / 0.05)
    problem = Problem(family, v, y, 1e-3)
    begin = WindowFit(np.zeros(1), 0.5, np.array([1.0, 0.5, 1.0]), 1e-3)
    fit = problem.with_intervals(problem.fitted(begin))
    of_gap = float(problem.remembered(fit, 120).rows[2, 2])
    assert (abs(of_gap) > 10.0) is told


def test_what_is_unexplained_does_not_depend_on_the_unit_of_y() -> None:
    v = 3.0 * np.sin(2.0 * np.pi * np.arange(400) / 61.8)
    found = []
    for unit in (1.0, 1e4):
        family = PlantFamily(TransferFunction([0.3 * unit], [1.0, -0.7]), 0.0)
        y = lfilter([0.3 * unit], [1.0, -0.7], play(v, 1.0, 0.5) - 0.5 + 0.02 * np.sin(1.7 * v))
        problem = Problem(family, v, y, 1e-3 * unit)
        begin = WindowFit(np.zeros(1), 0.5, np.array([1.0, 0.5, 1.0]), 1e-3 * unit)
        found.append(problem.finished(problem.fitted(begin)).unexplained)
    assert found[1] == pytest.approx(found[0], rel=1e-6)
    assert 1e-3 < found[0] < 0.1


def test_a_wrong_sign_is_named_only_where_it_is_certain() -> None:
    family = PlantFamily(TransferFunction([0.3], [1.0, -0.7]), 0.0)
    bounds = Bounds((0.1, 10.0), (0.0, 10.0), (-10.0, 0.0))
    setup = Setup(family, 1e-3, bounds, 20.0, 1.0, 0.0, np.zeros(3))
    for std, named in ((0.1, True), (0.5, False)):
        cov = np.diag([std**2, 0.01, 0.01])
        fit = WindowFit(np.zeros(1), 0.0, np.array([-1.0, 0.1, 1.0]), 1e-3, cov=cov)
        assert setup.moves_against(fit) is named


@pytest.mark.parametrize('seed', range(8))
def test_what_readings_tell_well_is_kept_while_the_size_of_the_error_is_open(seed: int) -> None:
    # Some directions of xi are known a thousand times as well as others.
    rng, xi_std, noise, freedom = np.random.default_rng(seed), 0.4, 0.45, 30.0
    turned = np.linalg.qr(rng.normal(size=(5, 5)))[0]
    rows = np.array([3e4, 900.0, 180.0, 45.0, 20.0])[:, None] * turned
    xi = xi_std * rng.normal(size=5)
    r = np.vstack([np.column_stack([rows, rows @ xi + noise * rng.normal(size=5)]), np.zeros(6)])
    fit = WindowFit(np.zeros(1), 0.0, np.zeros(8), 1.0)
    mean, cov, *_ = error_of_plant(fit, r, freedom * noise**2, freedom)
    assert np.sum((rows @ (mean - xi)) ** 2) < 30.0 * noise**2  # chi-square of five: 1e-5
    assert np.all(np.abs(mean - xi) < 5.0 * np.sqrt(np.diag(cov)))


def test_a_fit_that_begins_at_its_optimum_ends_there() -> None:
    rng = np.random.default_rng(4)
    v = np.cumsum(rng.normal(0.0, 0.4, 400))
    family = PlantFamily(two_poles(0.1), 0.2)
    xi = np.log(2.0) / 0.2  # G is twice as fast as the nominal one
    y = lfilter(*family.at([0.0, 0.0, xi, 0.0]), 1.5 * (play(v, 1.0, v[0]) - 0.3))
    y += 1e-3 * rng.standard_normal(len(v))
    setup = Setup(family, 1e-3, Parameters().estimator.bounds, 20.0, 2.0, 0.0, np.zeros(3))
    record = Window(0, v, y, np.full(len(v), np.nan))
    problem, best = setup.problem(record), afresh(setup, record)
    assert best is not None
    assert best.xi[2] == pytest.approx(xi, abs=0.05)
    again = problem.finished(problem.fitted(best))
    assert again.theta == pytest.approx(best.theta, rel=1e-3, abs=1e-3)
    assert again.scale == best.scale > 1.0
    assert again.evidence == pytest.approx(best.evidence, abs=0.1)


def test_three_steps_suffice_where_m_stands_in_for_an_error_of_G() -> None:
    family = PlantFamily(TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR), 0.2)
    k = np.arange(1000)
    v = 300.0 * np.sin(0.063 * k) + 100.0 * np.sin(0.2 * k)
    u = 1.3 * play(v, 6.0, 3.0) - 3.9
    y = lfilter(*family.at([0.0] * family.count), u)
    problem = Problem(family, v, y + 1e-3 * np.random.default_rng(1).standard_normal(len(v)), 1e-3)
    begin = WindowFit(np.zeros(1), 3.0, np.array([1.3, 3.9, 6.0, *[0.0] * family.count]), 1e-3)
    another = problem.holding(1.25, 3.0, -3.0).fitted(begin, 40)
    fit = problem.finished(problem.fitted(another, FEW_STEPS))
    assert fit.m == pytest.approx(1.3, abs=1e-3)
    assert fit.left.rms < 1e-2


def test_readings_that_repeat_one_rounding_count_as_one() -> None:
    y, known = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 9.0]), np.arange(6) < 5
    weights, number = independence(y, known, np.full(6, 1.2), 1.0)
    assert weights == pytest.approx([0.4] * 5 + [0.0])  # two rows of equal ones
    assert number.tolist() == [0, 0, 0, 1, 1]
    assert independence(y, known, 0.1 * np.arange(6), 1.0)[0].tolist() == known.tolist()


def test_a_motion_that_is_repeated_repeats_its_rounding_unless_noise_makes_it_differ() -> None:
    output, known = np.tile([0.1, 1.7, 4.4, 2.2, -1.3, 0.8], 5), np.full(30, True)
    weights, number = independence(np.round(output), known, output, 1.0)
    # But for its first and last reading, which do not move as the others.
    assert 6 <= weights.sum() <= 8
    assert np.array_equal(number[7:12], number[13:18])
    rng = np.random.default_rng(3)
    noisy = np.round(output + rng.standard_normal(30))
    assert independence(noisy, known, output, 1.0)[0].sum() > 25
    moved = output + np.repeat(0.1 * np.arange(5), 6)
    assert independence(np.round(moved), known, moved, 1.0)[0].tolist() == [1.0] * 30


def test_rare_readings_of_a_stay_count_no_more_than_the_others() -> None:
    y = np.where(np.arange(200) % 10 == 3, 1.0, 0.0)
    for noise_std in (np.inf, 0.4, 0.3):
        weights, _ = independence(y, np.full(200, True), np.full(200, 0.4), 1.0, noise_std)
        assert weights @ y / weights.sum() == pytest.approx(0.1)
    # Little noise leaves the same rounding error to all of them, however many there are.
    assert weights.sum() < 3.0


@pytest.mark.parametrize('noise', [0.06, 0.15, 0.3])
def test_noise_that_spreads_readings_at_rest_over_two_steps_shifts_no_gap(noise: float) -> None:
    errors = []
    for seed in range(6):
        rng, step = np.random.default_rng(seed), 0.02
        v = moves_with_rests(rng.uniform(-3.0, 3.0, 14), 0.02, 200)
        y = lfilter([0.3], [1.0, -0.7], play(v, 1.0, 0.5) - 0.5) \
            + noise * step * rng.standard_normal(len(v))
        problem = Problem(PlantFamily(TransferFunction([0.3], [1.0, -0.7]), 0.0), v,
                          step * np.round(y / step), 1e-4)
        begin = WindowFit(np.zeros(1), 0.5, np.array([1.0, 0.5, 1.0]), 1e-3)
        found = problem.with_intervals(problem.finished(problem.fitted(begin)))
        assert found.step
        errors.append(found.gap - 1.0)
    assert np.sqrt(np.mean(np.square(errors))) < 5e-4


INTEGRATOR = PlantFamily(TransferFunction([0.0, 0.1], [1.0, -1.0]), 0.0)
# V stays within the gap at first; after an integrator, what p is off by there is a drift of y.
V = np.where(np.arange(80) < 40, 0.2, 4.0) * np.sin(0.3 * np.arange(80))
GAP = 2.3


def read(share: float) -> np.ndarray:
    """y of G with p0 at this share of the gap."""
    y = lfilter(*INTEGRATOR.at([]), play(V, GAP, V[0] + share * GAP))
    return y + 1e-3 * np.random.default_rng(1).standard_normal(len(V))


def test_a_beginning_between_those_compared_changes_nothing() -> None:
    found = [search(INTEGRATOR, V, read(share), 1e-3, 50.0, np.zeros(0))[0][0]
             for share in (0.07, 0.18, 0.41, 0.6)]
    assert len({round(one.gap, 6) for one in found}) == 1


def test_a_gap_is_no_likelier_than_with_the_best_beginning_within_it() -> None:
    y, (b, a) = read(0.9), INTEGRATOR.at([])
    found, null = search(INTEGRATOR, V, y, 1e-3, 50.0, np.zeros(0))
    common = [lfilter([1.0], a, np.eye(1, len(V))[0]), lfilter(b, a, np.ones(len(V)))]

    def value(gap: float, p0: float) -> float:
        columns = np.array([*common, lfilter(b, a, play(V, gap, p0))]).T
        rest = y - columns @ np.linalg.lstsq(columns, y, rcond=None)[0]
        return float(-0.5 * (len(V) - 2) * np.log((rest @ rest + 1e-6) / len(V)))

    narrow = [one for one in found if one.gap < 0.5 * GAP]
    assert len(narrow) > 10
    for one in narrow:
        most = max(value(one.gap, p0) for p0 in V[0] + one.gap * np.linspace(0.0, 1.0, 41))
        assert one.evidence < most + 0.1 * (found[0].evidence - null)


MODELS = {
    'resonance': StateModel(resonance()),
    'integrating': StateModel(TransferFunction(PAPER_NUMERATOR, PAPER_DENOMINATOR)),
    'delayed': StateModel(TransferFunction([0.2, 0.1], [1.0, -0.7, 0.0, 0.0])),
}


def stationary(model: StateModel, ratio: float) -> tuple[np.ndarray, float, np.ndarray]:
    """Gain, variance of the innovation and covariance of x, by iterating the Kalman filter.

    In units of the variance of y.
    """
    power = abs(model.transfer_function.response(np.exp([0.1j * np.pi]))[0])
    noise = np.outer(model.b, model.b) * (ratio / power) ** 2
    noise += 1e-9 * np.trace(noise) * np.eye(model.order)
    c = np.zeros(model.order)
    c[0] = model.c
    p = np.eye(model.order)
    for _ in range(20_000):
        variance = c @ p @ c + 1.0
        gain = p @ c / variance
        kept = p - np.outer(gain, gain) * variance
        p = model.a @ kept @ model.a.T + noise
    return gain, float(variance), kept


@pytest.mark.parametrize('ratio', [RATIOS[3], RATIOS[4], RATIOS[6]])
@pytest.mark.parametrize('name', sorted(MODELS))
def test_gain_is_that_of_the_stationary_kalman_filter(name: str, ratio: float) -> None:
    model = MODELS[name]
    found = gain_of(model, ratio)
    gain, variance, cov = stationary(model, ratio)
    assert np.array(found.gain) == pytest.approx(gain, rel=1e-3, abs=1e-4 * max(abs(gain)))
    assert found.innovation**2 == pytest.approx(variance, rel=1e-3)
    assert found.cov == pytest.approx(cov, rel=1e-2, abs=1e-3 * np.trace(cov))
