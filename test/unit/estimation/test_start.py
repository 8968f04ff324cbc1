"""Where the play output began: anywhere within the gap, as far as the samples do not tell."""

from __future__ import annotations

import numpy as np
import pytest
from records import Truth, output, resonance, swing

from backlash_ros.core.estimation.fit.pace import Pace, drained
from backlash_ros.core.estimation.fit.relabelling import Fitted, fitted
from backlash_ros.core.estimation.fit.solution import Around
from backlash_ros.core.estimation.fit.window_fit import WindowFit
from backlash_ros.core.estimation.regression.error_model import build_error_model
from backlash_ros.core.estimation.regression.play import Start
from backlash_ros.core.plant.state_model import StateModel

TRUTH = Truth()
NOISE = 1e-3


def fit_from(share: float, seed: int) -> tuple[Fitted, float]:
    """A fit that begins with p at this share of the gap, and the first v."""
    model = StateModel(resonance())
    around = Around(build_error_model(model, 0.2), NOISE)
    v = swing(500, seed=seed)
    y = output(resonance(5.5), v, TRUTH, NOISE)
    start = Start(TRUTH.gap, float(v[0]) + share * TRUTH.gap)
    return drained(fitted(v, y, around, start, TRUTH.m, Pace())), float(v[0])


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('share', [0.1, 0.3, 0.7, 0.9])
def test_it_is_never_believed_to_be_far_outside_of_the_gap(share: float, seed: int) -> None:
    result, first = fit_from(share, seed)
    assert abs(result.solution.start - first - 0.5 * TRUTH.gap) < 0.7 * TRUTH.gap


def test_pieces_of_columns_that_are_taken_later_leave_the_first_v_as_it_is() -> None:
    model = StateModel(resonance())
    v = swing(500, seed=1)
    y = output(resonance(5.5), v, TRUTH, NOISE)
    start = Start(TRUTH.gap, float(v[0]) + 0.3 * TRUTH.gap)
    found = []
    for piece in (500, 100):
        fit = WindowFit(
            Around(build_error_model(model, 0.2), NOISE), start, TRUTH.m,
            (float(np.abs(y).max()), float(np.abs(v).max())),
        )
        rows = np.concatenate([
            fit.columns(v[k:k + piece], y[k:k + piece]) for k in range(0, 500, piece)
        ])
        fit.samples.take(rows, y, np.ones(500))
        found.append(fit.solve().start)
    assert found[0] == pytest.approx(found[1], rel=1e-9)
