"""Saves estimates without holding up the loop."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimates_file import save_estimate
from backlash_ros.core.parameters import Parameters


class EstimateSaver:
    """Writes to one file, one writing after the other.

    file: path, empty for none.
    """

    def __init__(self, file: str) -> None:
        self.file = file
        # A disk that is slow to confirm a file would cost samples.
        self._thread = ThreadPoolExecutor(1, thread_name_prefix='estimates')

    def save(self, estimate: Estimate, p: Parameters) -> Future[str]:
        """Begin to save; the result says why it failed, empty if it did not."""
        return self._thread.submit(self._write, estimate, p)

    def close(self) -> None:
        """Wait until everything is written."""
        self._thread.shutdown()

    def _write(self, estimate: Estimate, p: Parameters) -> str:
        try:
            save_estimate(Path(self.file), estimate, p)
        except OSError as error:
            return f'estimates.file={self.file!r} cannot be written: {error.strerror}'
        return ''
