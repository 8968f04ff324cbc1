"""The loop between two hosts: driver on one, controller on the other, and a cable between them.

The hosts are network namespaces of this machine (linked_hosts.py): Linux and root only. The driver
is examples/motor_driver.py with the true backlash that simulated_motor.py names.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import NamedTuple

sys.path.append(str(Path(__file__).resolve().parents[1] / 'examples'))

import simulated_motor
from hosts.linked_hosts import FIRST, Cable, Host, linked_hosts, why_not
from reporting import ROOT, machine, markdown_table, text_table

from backlash_ros.middleware.loopback import prefer_loopback
from backlash_ros.tools.bringup.environment import free_domain, with_source

DRIVER = ROOT / 'examples' / 'motor_driver.py'
CONFIG = 'geared_motor.yaml'
DOCUMENT = ROOT / 'docs' / 'deployment.md'
MARK = re.compile(
    r'(<!-- hosts: made by benchmarks/two_hosts\.py -->\n).*?(<!-- end -->)', re.DOTALL
)
TRUTH = {'m': simulated_motor.SLOPE, 'c_r': simulated_motor.C_R, 'c_l': simulated_motor.C_L}
WITHIN = 0.01  # of the truth, as in summary.json
# Fast DDS may miss for good who starts at the same moment.
DRIVER_FIRST_S = 2.0
START_S, STOP_S = 60.0, 20.0  # for processes to meet, beyond the duration, and to end
PULLED_AT_S, PULLED_S = 4.0, 3.0


class Case(NamedTuple):
    """What lies between driver and controller; cable: None for a bare veth pair.

    pulled_s: for how long the cable is pulled; the run takes as much longer.
    """

    name: str
    two: bool = True
    cable: Cable | None = None
    pulled_s: float = 0.0


CASES = (
    Case('one host', two=False),
    Case('veth pair'),
    Case('cable', cable=Cable()),
    Case('1 ms each way', cable=Cable(1.0)),
    Case('5 ms', cable=Cable(5.0)),
    Case('5 ± 2 ms', cable=Cable(5.0, 2.0)),
    Case('20 ms', cable=Cable(20.0)),
    Case('0.1 % lost', cable=Cable(loss_percent=0.1)),
    Case('1 % lost', cable=Cable(loss_percent=1.0)),
    Case('5 % lost', cable=Cable(loss_percent=5.0)),
    Case(f'link down for {PULLED_S:g} s', pulled_s=PULLED_S),
)


class Row(NamedTuple):
    """What came of a run. learned_s: from when the estimates stay within 1 %, inf for never."""

    samples: int
    lost: int  # on the way
    unsent: int  # by the driver
    late: int  # commands
    p50_ms: float
    p99_ms: float
    learned_s: float
    error: float  # of the gap, at the end
    tracking: float  # share of samples
    largest_step: float  # of v between two samples
    last_finding: str

    @property
    def cells(self) -> list[str]:
        """Cells of the table."""
        return [
            str(self.samples), str(self.lost), str(self.unsent), str(self.late),
            f'{self.p50_ms:.2f}', f'{self.p99_ms:.2f}',
            f'{self.learned_s:.1f}' if isfinite(self.learned_s) else 'never',
            f'{100.0 * self.error:.2g} %', f'{100.0 * self.tracking:.0f} %',
            f'{self.largest_step:.2f}', self.last_finding,
        ]


HEADER = (
    'between them', 'samples', 'lost', 'never sent', 'late v', 'y to v p50 [ms]', 'p99 [ms]',
    'within 1 % from [s]', 'error of the gap', 'tracking', 'largest step of v', 'said most',
)


def environment(domain: int, peer: str) -> dict[str, str]:
    """As docs/deployment.md says."""
    chosen = with_source(os.environ)
    chosen.pop('FASTRTPS_DEFAULT_PROFILES_FILE', None)
    chosen |= {
        'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_STATIC_PEERS': peer, 'OMP_NUM_THREADS': '1',
    }
    prefer_loopback(chosen)
    return chosen


@contextmanager
def driver(host: Host | None, domain: int, log: Path) -> Iterator[None]:
    """The example driver on its host, or on this one."""
    command = [sys.executable, str(DRIVER)]
    with log.open('wb') as out:
        process = subprocess.Popen(
            [*FIRST, *command] if host is None else host.command(*command),
            stdin=subprocess.DEVNULL, stdout=out, stderr=out,
            env=environment(domain, host.peer if host else ''),
        )
        try:
            yield
        finally:
            _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def run(case: Case, duration_s: float, folder: Path) -> Row:
    """One run with a fresh pair of hosts; raises RuntimeError where no result comes."""
    duration_s += case.pulled_s
    with ExitStack() as stack:
        domain = stack.enter_context(free_domain())
        hosts = stack.enter_context(linked_hosts(case.cable)) if case.two else (None, None)
        stack.enter_context(driver(hosts[0], domain, folder / 'driver.log'))
        time.sleep(DRIVER_FIRST_S)
        out = folder / 'results'
        command = [
            sys.executable, '-m', 'backlash_ros.tools.bringup', '--config', CONFIG,
            '--driver', 'none', '--duration', str(duration_s), '--out', str(out),
        ]
        here = hosts[1]
        with (folder / 'bringup.log').open('wb') as log:
            process = subprocess.Popen(
                [*FIRST, *command] if here is None else here.command(*command),
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=folder,
                env=environment(domain, here.peer if here else ''),
            )
            try:
                if case.pulled_s:
                    assert hosts[0] is not None
                    _pull(hosts[0], case.pulled_s, folder / 'bringup.log')
                process.wait(duration_s + START_S)
            except subprocess.TimeoutExpired:
                pass
            finally:
                _end(process)
        if not (out / 'summary.json').exists():
            raise RuntimeError(f'{case.name}: {(folder / "bringup.log").read_text()}')
        return _row(out)


def _pull(host: Host, pulled_s: float, log: Path) -> None:
    """Pull the cable for a while, some time after the first progress."""
    deadline = time.monotonic() + START_S
    while not re.search(r' s +\d+/\d+', log.read_text()):
        if time.monotonic() > deadline:
            return
        time.sleep(0.1)
    time.sleep(PULLED_AT_S)
    host.set_link('down')
    time.sleep(pulled_s)
    host.set_link('up')


def _row(out: Path) -> Row:
    summary = json.loads((out / 'summary.json').read_text())
    log = (out / 'logs' / 'controller.log').read_text()
    unsent, late = _count(log, 'of these never sent'), _count(log, 'late')
    with (out / 'samples.csv').open(encoding='utf-8', newline='') as file:
        rows = list(csv.DictReader(file))
    within = [
        all(abs(float(row[name]) - true) <= WITHIN * abs(true) for name, true in TRUTH.items())
        for row in rows
    ]
    last_off = max((i for i, good in enumerate(within) if not good), default=-1)
    learned = float(rows[last_off + 1]['t']) if last_off + 1 < len(rows) else float('inf')
    v = [float(row['v']) for row in rows]
    gap, final = TRUTH['c_r'] - TRUTH['c_l'], summary['final']
    return Row(
        summary['samples'], _count(log, 'lost') - unsent, unsent, late,
        summary['loop_latency_ms']['p50'], summary['loop_latency_ms']['p99'], learned,
        abs(final['c_r'] - final['c_l'] - gap) / gap, summary['status_share']['tracking'],
        max(abs(b - a) for a, b in pairwise(v)), _said_most(log),
    )


def _count(log: str, what: str) -> int:
    """A count of the controller's last line."""
    found = re.findall(rf'[ ,]{what}: (\d+)', log)
    return int(found[-1]) if found else 0


def _said_most(log: str) -> str:
    """Kinds of warnings, without their figures, the most frequent one."""
    said = re.findall(r'\[(?:WARN|ERROR)\] \[[\d.]+\] \[controller\]: (.*)', log)
    kinds = [re.sub(r'[\d.]+ % of ', '', text) for text in said]
    return max(kinds, key=kinds.count, default='')


def write_document(rows: Sequence[Sequence[str]], duration_s: float) -> None:
    """Write the table between its marks."""
    made = (
        f'{machine()}; runs of {duration_s:g} s, the one whose link is down {PULLED_S:g} s longer.'
        f'\n\n{markdown_table(HEADER, rows)}\n\n'
    )
    text = DOCUMENT.read_text(encoding='utf-8')
    DOCUMENT.write_text(
        MARK.sub(lambda mark: f'{mark[1]}{made}{mark[2]}', text), encoding='utf-8'
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--duration', type=float, default=10.0, help='of a run [s]')
    parser.add_argument('--repeat', type=int, default=1, help='runs of each case, in turns')
    parser.add_argument('--case', action='append', default=[], help='only those; default: all')
    parser.add_argument('--write', action='store_true',
                        help=f'write the table into {DOCUMENT.relative_to(ROOT)}')
    options = parser.parse_args(arguments)
    if reason := why_not():
        print(f'two_hosts: skipped: {reason}', file=sys.stderr)
        return 0
    cases = [case for case in CASES if not options.case or case.name in options.case]
    rows = []
    for _ in range(options.repeat):
        for case in cases:
            with tempfile.TemporaryDirectory() as folder:
                rows.append([case.name, *run(case, options.duration, Path(folder)).cells])
            print(' | '.join(rows[-1]), file=sys.stderr, flush=True)
    print(machine())
    print(text_table(HEADER, rows))
    if options.write:
        write_document(rows, options.duration)
    return 0


if __name__ == '__main__':
    sys.exit(main())
