"""For all tests: what examples property tests draw, the order of the tests, fixtures."""

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
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

settings.register_profile(
    'repeatable', derandomize=True, database=None, deadline=None, max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],  # it measures time, which no test here may
)
# For a hunt by hand: pytest --hypothesis-profile=search
settings.register_profile('search', deadline=None, max_examples=1000)
settings.load_profile('repeatable')

STARTS_PROCESSES = {'bringup_processes', 'paced_driver', 'ros_processes'}
# Their tests look at the same runs, so one worker of pytest-xdist makes these for all of them.
SHARE_RUNS = {
    'test_bag_repair', 'test_combinations', 'test_compare', 'test_identify', 'test_live',
    'test_packaging', 'test_replay', 'test_report', 'test_report_sections', 'test_two_hosts',
}


def pytest_configure() -> None:
    """Hear Ctrl-C even where the tests run in the background of a script.

    A shell lets its background jobs ignore SIGINT, and whatever they start would inherit that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


class SharedRuns(LoadScopeScheduling):
    """Gives the next test to the worker that is free, and the files of SHARE_RUNS as a whole."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.split('::')[0]
        return file if Path(file).stem in SHARE_RUNS else nodeid


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> SharedRuns:
    """The scheduler of pytest-xdist."""
    return SharedRuns(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests with processes at the end: beside each other, not beside those that compute.

    They run against the clock of a machine that they do not have to themselves, so each may be
    run once again, as `colcon test --retest-until-pass 1` does; the summary names those that were.
    """
    items.sort(key=_starts_processes)
    for item in items:
        if _starts_processes(item):
            item.add_marker(pytest.mark.flaky(reruns=1))


def _starts_processes(item: pytest.Item) -> bool:
    assert isinstance(item, pytest.Function)
    helpers = {getattr(each, '__module__', '') for each in vars(item.module).values()}
    return 'start' in item.fixturenames or bool(helpers & STARTS_PROCESSES)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without what takes most of their time, for tests of all else that they hold."""
    monkeypatch.setattr(FigureCanvasAgg, 'print_png', leave_out)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    """Start bringup with arguments; whatever is left of it at the end is killed."""
    with bringup_sessions(tmp_path) as start_session:
        yield start_session
