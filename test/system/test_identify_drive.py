"""identify --drive beside the example driver: it moves within limits, comes to rest, finds."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from places import ROOT
from ros_processes import Probe
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.tools.bringup.environment import child_environment, free_domain

DEADLINE_S = 150.0
LOW, HIGH, RATE, PERIOD_S = -9.0, 11.0, 200.0, 0.005
LIMITS = (
    f'/**: {{ros__parameters: {{sample_period: {PERIOD_S}, '
    f'control: {{min: {LOW}, max: {HIGH}, rate_max: {RATE}}}}}}}'
)


class Bench:
    """A domain, the example driver in it if wanted, and the commands that it hears."""

    def __init__(self, folder: Path, domain: int, with_driver: bool) -> None:
        self.folder = folder
        self.environment = child_environment(folder, domain)
        self.probe = Probe(domain)
        self.control = self.probe.collect(topics.CONTROL, Float64)
        (folder / 'limits.yaml').write_text(LIMITS)
        self.driver = subprocess.Popen(
            [sys.executable, str(ROOT / 'examples' / 'motor_driver.py')], env=self.environment,
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        ) if with_driver else None

    def start(self, *options: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, '-m', 'backlash_ros.tools.identify', '--drive',
             '--config', str(self.folder / 'limits.yaml'), '--out', str(self.folder / 'out'),
             *options],
            env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )

    def finish(self, process: subprocess.Popen[str]) -> tuple[int, str]:
        """Exit code and all that was printed, once it has ended; what was sent is in control."""
        try:
            begin = time.monotonic()
            while process.poll() is None and time.monotonic() < begin + DEADLINE_S:
                self.probe.spin(0.02)
            out, err = process.communicate(timeout=DEADLINE_S)
            # On a busy machine the last commands still wait to be taken in, one at a time.
            taken = -1
            while len(self.control) > taken:
                taken = len(self.control)
                self.probe.spin(0.2)
        finally:
            process.kill()
        return process.returncode, out + err

    def sent(self) -> list[float]:
        return [message.data for message in self.control]

    def close(self) -> None:
        if self.driver is not None:
            self.driver.kill()
            self.driver.wait()
        self.probe.close()


@contextmanager
def bench(folder: Path, with_driver: bool = True) -> Iterator[Bench]:
    with free_domain() as domain:
        made = Bench(folder, domain, with_driver)
        try:
            yield made
        finally:
            made.close()


def assert_limits_kept(sent: list[float]) -> None:
    assert sent
    assert min(sent) >= LOW
    assert max(sent) <= HIGH
    # A message may be missed, and then two moves look like one.
    moves = sorted(abs(b - a) for a, b in pairwise(sent))
    assert moves[int(0.99 * len(moves))] <= RATE * PERIOD_S * (1.0 + 1e-9)


def test_an_unknown_actuator_is_found(tmp_path: Path) -> None:
    with bench(tmp_path) as made:
        code, text = made.finish(made.start('--duration', '10', '--slope', '0.098'))
        sent = made.sent()
    assert code == 0, text
    assert_limits_kept(sent)
    assert max(sent) > 0.9 * HIGH
    assert min(sent) < 0.9 * LOW
    assert sent[-1] == 0.0
    found = json.loads((tmp_path / 'out' / 'identified.json').read_text())
    assert found['gap'] == pytest.approx(0.9, abs=0.01)
    assert found['c_r'] == pytest.approx(0.55, abs=0.01)
    assert found['delay_samples'] == 0
    assert sum(found['numerator']) / sum(found['denominator']) == pytest.approx(1.0, rel=0.01)
