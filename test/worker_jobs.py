"""Jobs for a worker process, which imports nothing else with them."""

import sys
import time
from pathlib import Path

import numpy as np


def checksum(values: np.ndarray, factor: float) -> tuple[int, float]:
    return len(values), factor * float(values @ np.arange(1.0, len(values) + 1.0))


def last_for_ever(begun: Path) -> None:
    begun.touch()
    while True:
        time.sleep(60.0)


def foreign_modules() -> list[str]:
    return sorted({name.partition('.')[0] for name in sys.modules} - sys.stdlib_module_names)
