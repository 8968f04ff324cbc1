"""Publishes estimates and signals one by one, for plots, while somebody listens."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.nodes.runtime.messages import without_events

PERIOD_S = 0.04  # between two messages of a topic; a loop at 1 kHz has no time for many more
LOOK_S = 0.5  # between two looks at who listens
DEPTH = 10  # messages that may wait for a subscriber
U_INDEX = topics.SIGNAL_LABELS.index('u_hat')
BAND = 2.0  # half width of the band around an estimate, in standard deviations


class WatchPublisher:
    """Publishes `controller/watch/<label>` for each label of which there is a subscriber.

    Of a joint that has a name: `controller/watch/<joint>/<label>`.

    The topics take turns, so that after a command of a fast loop one message leaves, not all.
    After v(k) comes the u that it led to, which is known with y(k+1): points of their loop.
    """

    def __init__(self, node: Node, joint: str = '') -> None:
        self._publishers: dict[str, Publisher] = {
            label: node.create_publisher(
                Float64, topics.of_node(topics.watched(label, joint)), DEPTH,
                event_callbacks=without_events(),
            ) for label in topics.WATCH_LABELS
        }
        self._message = Float64()
        self._heard: list[str] = []  # labels with a subscriber
        self._turn = -1  # whose turn it was among these
        self._looked_at_s = self._sent_at_s = -inf
        self._v_sent = False  # with the newest sample, so that its u is that of the next one
        self._u_of_v: float | None = None  # u that belongs to the v that was sent last

    def follow(self, signals: Sequence[float], estimates: Sequence[float], now_s: float) -> None:
        """Publish what is due of a sample.

        signals, estimates: its rows, in the order of their labels. now_s: on the steady clock.
        """
        if now_s >= self._looked_at_s + LOOK_S:
            self._looked_at_s = now_s
            self._heard = [
                label for label, publisher in self._publishers.items()
                if publisher.get_subscription_count()
            ]
        if not self._heard:
            return
        if self._v_sent:
            self._v_sent, self._u_of_v = False, signals[U_INDEX]
        spacing = PERIOD_S / len(self._heard)
        # After a pause each is due once.
        self._sent_at_s = max(self._sent_at_s, now_s - PERIOD_S)
        # The comparison of times must not lose one message of each round to rounding.
        due = int((now_s - self._sent_at_s) / spacing + 1e-6)
        if not due:
            return
        values = watched_values(signals, estimates)
        for _ in range(due):
            turn = (self._turn + 1) % len(self._heard)
            label = self._heard[turn]
            if label == 'u_hat' and self._v_sent:
                return
            self._turn = turn
            self._sent_at_s += spacing
            self._message.data = values[label]
            if label == 'u_hat' and self._u_of_v is not None:
                self._message.data, self._u_of_v = self._u_of_v, None
            self._v_sent = self._v_sent or label == 'v'
            self._publishers[label].publish(self._message)


def watched_values(signals: Sequence[float], estimates: Sequence[float]) -> dict[str, float]:
    """The value of each of WATCH_LABELS, nan for bands where the law has no deviations."""
    signal = dict(zip(topics.SIGNAL_LABELS, signals, strict=True))
    estimate = dict(zip(topics.ESTIMATE_LABELS, estimates, strict=True))
    values = {'gap': estimate['c_r'] - estimate['c_l']}
    for name in ('m', 'c_r', 'c_l'):
        value, half = estimate[name], BAND * estimate[f'std_{name}']
        values |= {name: value, f'{name}_low': value - half, f'{name}_high': value + half}
    return values | {name: value for name, value in signal.items() if name != 'sample'}
