"""Which tests run beside which: those that wait for processes beside those that compute."""

from __future__ import annotations

import os
import re
from functools import cache
from pathlib import Path

from xdist.scheduler import LoadScopeScheduling
from xdist.workermanage import WorkerController

# Whoever imports one of these runs processes against the clock.
HELPERS = '|'.join([
    'bringup_processes', r'drivers\.paced_driver', 'hosts', 'live_pages', 'ros_processes',
])
IMPORT = re.compile(rf'^from ({HELPERS})[. ]', re.MULTILINE)
# Their tests look at the same runs, so one worker makes these for all of them.
SHARE_RUNS = {
    'test_actuator_fit', 'test_bag_repair', 'test_combinations', 'test_compare', 'test_identify',
    'test_live', 'test_packaging', 'test_physics', 'test_replay', 'test_report',
    'test_report_figures', 'test_report_sections', 'test_rounding', 'test_two_hosts',
}
NICENESS = 10  # of what only computes: processes that are late would fail


@cache
def starts_processes(file: Path) -> bool:
    """Whether tests of this file start processes that keep to a time."""
    return IMPORT.search(file.read_text()) is not None


def only_computes(worker: str) -> bool:
    """Whether a worker of pytest-xdist, gw0 or gw1 or ..., begins with tests that compute."""
    return worker.startswith('gw') and int(worker.removeprefix('gw')) % 2 == 0


def give_way() -> None:
    """Leave the processors to the other workers if this one only computes."""
    if only_computes(os.environ.get('PYTEST_XDIST_WORKER', '')):
        os.nice(NICENESS)


class FromBothEnds(LoadScopeScheduling):
    """Half of the workers take tests from the front, half from the end, where processes are.

    A test goes to the worker that is free, and the files of SHARE_RUNS go as a whole.
    """

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.split('::')[0]
        return file if Path(file).stem in SHARE_RUNS else nodeid

    def _assign_work_unit(self, node: WorkerController) -> None:
        if not only_computes(node.gateway.id):
            self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
        super()._assign_work_unit(node)
