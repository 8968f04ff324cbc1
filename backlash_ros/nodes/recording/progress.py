"""How the run is going, as its messages tell; of several joints, how that of the first one is."""

from __future__ import annotations

from collections import deque

from rclpy.serialization import deserialize_message
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics


class Progress:
    """The newest rows, still serialised, and what they say about the run."""

    def __init__(self) -> None:
        self._estimates = b''
        self._truth = b''
        # The truth of a sample follows its signals by one sample.
        self._signals: deque[bytes] = deque(maxlen=8)
        self._first = b''
        self._rows = 0

    def take(self, topic: str, message: bytes) -> None:
        """Remember a row of one of the array topics."""
        if topic == topics.ESTIMATES:
            self._estimates = message
        elif topic == topics.TRUTH:
            self._truth = message
        elif topic == topics.SIGNALS:
            self._first = self._first or message
            self._signals.append(message)
            self._rows += 1

    def report(self) -> dict[str, object]:
        """Content of a progress event, empty before the first sample."""
        if not (self._estimates and self._signals):
            return {}
        signals = [_row(message, topics.SIGNAL_LABELS) for message in self._signals]
        first, newest = _row(self._first, topics.SIGNAL_LABELS), signals[-1]
        estimates = _row(self._estimates, topics.ESTIMATE_LABELS)
        truth = _row(self._truth, topics.TRUTH_LABELS) if self._truth else {}
        same = [row for row in signals if row['sample'] == truth.get('sample')]
        return {
            'sample': int(min(newest['sample'], estimates['sample'])),
            'status': int(newest['status']),
            **{name: estimates[name] for name in (
                'm', 'c_r', 'c_l', 'f', 'std_m', 'std_c_r', 'std_c_l',
            )},
            **{f'true_{name}': truth.get(name) for name in ('m', 'c_r', 'c_l')},
            'control_error': truth['u'] - same[0]['u_d'] if same else None,
            'lost': int(newest['sample'] - first['sample']) + 1 - self._rows,
        }


def _row(message: bytes, labels: tuple[str, ...]) -> dict[str, float]:
    return dict(zip(labels, deserialize_message(message, Float64MultiArray).data, strict=False))
