"""For all tests: what examples property tests draw, the order of the tests, a fixture."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bringup_processes import Session, bringup_sessions
from hypothesis import HealthCheck, settings

settings.register_profile(
    'repeatable', derandomize=True, database=None, deadline=None, max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],  # it measures time, which no test here may
)
# For a hunt by hand: pytest --hypothesis-profile=search
settings.register_profile('search', deadline=None, max_examples=1000)
settings.load_profile('repeatable')

STARTS_PROCESSES = {'bringup_processes', 'paced_driver', 'ros_processes'}


def pytest_configure() -> None:
    """Hear Ctrl-C even where the tests run in the background of a script.

    A shell lets its background jobs ignore SIGINT, and whatever they start would inherit that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests with processes at the end: beside each other, not beside those that compute."""
    items.sort(key=_starts_processes)


def _starts_processes(item: pytest.Item) -> bool:
    assert isinstance(item, pytest.Function)
    helpers = {getattr(each, '__module__', '') for each in vars(item.module).values()}
    return 'start' in item.fixturenames or bool(helpers & STARTS_PROCESSES)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    """Start bringup with arguments; whatever is left of it at the end is killed."""
    with bringup_sessions(tmp_path) as start_session:
        yield start_session
