"""Signals that ask for the end, while something is to be brought to an end first."""

from __future__ import annotations

import signal
from types import FrameType, TracebackType
from typing import Any


class StopRequests:
    """Counts SIGINT, SIGTERM and SIGHUP as long as the context lasts, instead of dying of them."""

    def __init__(self) -> None:
        self.count = 0
        self.last = ''
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequests:
        for caught in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # Under nohup a hang-up stays ignored.
            if caught != signal.SIGHUP or signal.getsignal(caught) is not signal.SIG_IGN:
                self._before[caught] = signal.signal(caught, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for caught, handler in self._before.items():
            signal.signal(caught, handler)

    def insist(self) -> bool:
        """Whether there was a second request."""
        return self.count > 1

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.last = signal.Signals(number).name
