"""For all tests: what examples property tests draw, the order of the tests, fixtures."""

import os
import signal
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

# Before numpy reads it, as `make test` has it: the workers would take the processors from each
# other, and the matrices are tiny.
os.environ.setdefault('OMP_NUM_THREADS', '1')

import pytest
from bringup_processes import Session, bringup_sessions
from hypothesis import HealthCheck, settings
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scheduling import FromBothEnds, give_way, starts_processes
from standstill import LOOK_BACK_S, OVERDUE, Standstill, excuse, is_overdue, ran_out_of_time
from undrawn import leave_out
from xdist.remote import Producer

STANDSTILL = Standstill()
STANDSTILL.start()

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
    give_way()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Two compute while two wait for processes; where the machine stands still, nothing waits."""
    time.sleep(1.0)  # to hear whether it does
    return 2 if STANDSTILL.reason(LOOK_BACK_S) else 4


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> FromBothEnds:
    """The scheduler of pytest-xdist."""
    return FromBothEnds(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put tests with processes at the end, where half of the workers begin.

    They run against the clock of a machine that they do not have to themselves, so each may be
    run once again, as `colcon test --retest-until-pass 1` does; the summary names those that were.
    """
    items.sort(key=lambda item: starts_processes(item.path))
    for item in items:
        if starts_processes(item.path):
            item.add_marker(pytest.mark.flaky(reruns=1))


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out a test against the clock while the machine itself stands still.

    There, any test once `make test` takes many times as long as elsewhere.
    """
    overdue = is_overdue(os.environ, time.time())
    if (overdue or starts_processes(item.path)) and (reason := STANDSTILL.reason(LOOK_BACK_S)):
        pytest.skip(OVERDUE if overdue else reason)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None],
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """The same for one that has failed meanwhile, or any that has waited in vain."""
    report = yield
    if report.failed and call.excinfo is not None and (
        starts_processes(item.path) or ran_out_of_time(call.excinfo.value)
    ) and (reason := STANDSTILL.reason(max(call.duration, LOOK_BACK_S))):
        excuse(report, reason)
    return report


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports without what takes most of their time, for tests of all else that they hold."""
    monkeypatch.setattr(FigureCanvasAgg, 'print_png', leave_out)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Session]]:
    """Start bringup with arguments; whatever is left of it at the end is killed."""
    with bringup_sessions(tmp_path) as start_session:
        yield start_session
