"""For all tests: what examples property tests draw, and fixtures."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

# Before numpy reads it, as `make test` has it: the workers would take the processors from each
# other, and the matrices are tiny.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import pytest
from bringup_processes import Session, bringup_sessions
from hypothesis import HealthCheck, settings
from matplotlib.backends.backend_agg import FigureCanvasAgg
from undrawn import leave_out

settings.register_profile(
    'repeatable', derandomize=True, database=None, deadline=None, max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],  # it measures time, which no test here may
)
# For a hunt by hand: pytest --hypothesis-profile=search
settings.register_profile('search', deadline=None, max_examples=1000)
settings.load_profile('repeatable')


def pytest_configure() -> None:
    """Hear Ctrl-C even where the tests run in the background of a script.

    A shell lets its background jobs ignore SIGINT, and whatever they start would inherit that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    return 1 + (os.cpu_count() or 1)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FigureCanvasAgg, 'print_png', leave_out)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    with bringup_sessions(tmp_path) as start_session:
        yield start_session
