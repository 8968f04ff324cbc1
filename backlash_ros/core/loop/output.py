"""One measured y with its times."""

from __future__ import annotations

from typing import NamedTuple


class Output(NamedTuple):
    """A measured y, when it was sampled, sent and received [ns], and its number."""

    y: float
    stamp_ns: int
    sent_ns: int
    received_ns: int
    sequence: int
