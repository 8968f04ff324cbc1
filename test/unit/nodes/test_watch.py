"""Estimates and signals one by one, for plots: their pace, their cost, their content."""

from collections.abc import Mapping
from math import nan
from typing import Any, cast

import pytest
from rclpy.node import Node
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.nodes.control.publishing import (
    WATCH_PERIOD_S,
    WatchPublisher,
    watched_values,
)

SIGNALS = tuple(float(i) for i, _ in enumerate(topics.SIGNAL_LABELS))
ESTIMATES = (1.3, 3.0, -2.0, 0.2, 0.1, 0.2, 0.3, nan, 7.0)


class FakePublisher:
    """Notes what is published and how often anybody asks for subscribers."""

    def __init__(self) -> None:
        self.listeners = self.looks = 0
        self.sent: list[float] = []

    def get_subscription_count(self) -> int:
        self.looks += 1
        return self.listeners

    def publish(self, message: Float64) -> None:
        self.sent.append(message.data)


class FakeNode:
    """Makes such publishers, kept by topic."""

    def __init__(self) -> None:
        self.publishers: dict[str, FakePublisher] = {}

    def create_publisher(
        self, message_type: type[Any], topic: str, *_: object, **__: object
    ) -> FakePublisher:
        assert message_type is Float64
        return self.publishers.setdefault(topic, FakePublisher())


def watch_of() -> tuple[WatchPublisher, Mapping[str, FakePublisher]]:
    node = FakeNode()
    return WatchPublisher(cast(Node, node)), node.publishers


def run(watch: WatchPublisher, rate_hz: float, seconds: float) -> None:
    for k in range(round(rate_hz * seconds)):
        watch.follow(SIGNALS, ESTIMATES, k / rate_hz)


@pytest.mark.parametrize('rate_hz', [10.0, 50.0, 60.0, 200.0, 1000.0, 5000.0])
def test_every_topic_keeps_to_the_lesser_of_its_bound_and_the_sampling_rate(rate_hz):
    watch, publishers = watch_of()
    for publisher in publishers.values():
        publisher.listeners = 1
    run(watch, rate_hz, 4.0)
    for publisher in publishers.values():
        # At the end those that follow v still wait for the sample after it.
        assert 0.99 * 4.0 * min(rate_hz, 1.0 / WATCH_PERIOD_S) - 1 <= len(publisher.sent)
        assert len(publisher.sent) <= 4.0 * min(rate_hz, 1.0 / WATCH_PERIOD_S) + 1


@pytest.mark.parametrize('rate_hz', [10.0, 100.0, 450.0, 1000.0])
@pytest.mark.parametrize('others', [True, False])
def test_u_is_the_one_that_the_v_before_it_led_to(rate_hz: float, others: bool) -> None:
    watch, publishers = watch_of()
    for topic, publisher in publishers.items():
        publisher.listeners = int(others or topic in ('~/watch/v', '~/watch/u_hat'))
    v, u = publishers['~/watch/v'].sent, publishers['~/watch/u_hat'].sent
    row = list(SIGNALS)
    for k in range(1000):
        # y(k) shows the u of the interval before it, over which v(k - 1) acted.
        row[topics.SIGNAL_LABELS.index('v')], row[topics.SIGNAL_LABELS.index('u_hat')] = k, k - 1
        before = len(u)
        watch.follow(row, ESTIMATES, k / rate_hz)
        assert u[before:] == v[before:len(u)]
    assert len(u) > 900 * min(1.0, 1.0 / WATCH_PERIOD_S / rate_hz)


def test_values_are_those_of_the_rows_with_bands_of_two_deviations() -> None:
    values = watched_values(SIGNALS, ESTIMATES)
    assert set(values) == set(topics.WATCH_LABELS)
    assert (values['m'], values['c_r'], values['c_l'], values['gap']) == (1.3, 3.0, -2.0, 5.0)
    assert (values['m_low'], values['m_high']) == pytest.approx((1.1, 1.5))
    assert (values['c_l_low'], values['c_l_high']) == pytest.approx((-2.6, -1.4))
    for label in ('y_m', 'y', 'u_d', 'v', 'u_hat', 'innovation', 'status', 'latency_s'):
        assert values[label] == SIGNALS[topics.SIGNAL_LABELS.index(label)]
