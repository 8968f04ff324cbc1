"""Estimates and signals one by one, as plots show them."""

from math import nan

import pytest

from backlash_ros import topics
from backlash_ros.nodes.control.publishing import watched_values

SIGNALS = tuple(float(i) for i, _ in enumerate(topics.SIGNAL_LABELS))
ESTIMATES = (1.3, 3.0, -2.0, 0.2, 0.1, 0.2, 0.3, nan, 7.0)


def test_values_are_those_of_the_rows_with_bands_of_two_deviations() -> None:
    values = watched_values(SIGNALS, ESTIMATES)
    assert set(values) == set(topics.WATCH_LABELS)
    assert (values['m'], values['c_r'], values['c_l'], values['gap']) == (1.3, 3.0, -2.0, 5.0)
    assert (values['m_low'], values['m_high']) == pytest.approx((1.1, 1.5))
    assert (values['c_l_low'], values['c_l_high']) == pytest.approx((-2.6, -1.4))
    for label in ('y_m', 'y', 'u_d', 'v', 'u_hat', 'innovation', 'status', 'latency_s'):
        assert values[label] == SIGNALS[topics.SIGNAL_LABELS.index(label)]
