"""One definition of latency: what /diagnostics says is what a report says of the same samples."""

from __future__ import annotations

import numpy as np

from backlash_ros.core.loop.loop_statistics import Lately, LoopStatistics
from backlash_ros.tools.runs.summary import latency_ms


def test_diagnostics_and_report_agree_on_the_latency_of_the_same_samples() -> None:
    latencies = np.random.default_rng(3).gamma(2.0, 1e-4, 40)
    statistics = LoopStatistics()
    for latency in latencies:
        statistics.note(0.0, 0.0, False, float(latency))
    reported = latency_ms(latencies)
    assert reported == {'p50': statistics.latency_ms(0.5), 'p99': statistics.latency_ms(0.99)}


def test_what_was_gained_lately_is_never_negative_after_a_new_beginning() -> None:
    lately = Lately()
    for t in range(10):
        gained = lately.gained({'used': 100 * t, 'lost': 0}, float(t))
    assert gained['used'] > 100
    assert lately.gained({'used': 40, 'lost': 3}, 10.0) == {'used': 40, 'lost': 3}
    assert lately.gained({'used': 90, 'lost': 3}, 11.0) == {'used': 50, 'lost': 0}
