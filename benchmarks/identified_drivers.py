"""Measure what a new user gets: `identify --drive` on the example drivers, then `bringup --driver`.

Real processes, with the commands of a user, from a file that holds limits and sample period alone.
`python benchmarks/identified_drivers.py` prints the table; `--write` puts it into the document.
"""

from __future__ import annotations

import argparse
import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from reporting import ROOT, machine, markdown_table, text_table

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.simulation.metrics import delayed_tracking_error_rms
from backlash_ros.tools.bringup.environment import child_environment, free_domain
from backlash_ros.tools.runs.source import read_run

EXAMPLES = ROOT / 'examples'
DOCUMENT = ROOT / 'docs' / 'identification.md'
MARKS = re.compile(
    r'(<!-- identified drivers: made by benchmarks -->\n).*?(<!-- end -->)', re.DOTALL
)
HEADER = ('driver', 'gap found', 'true gap', 'uncompensated', 'compensated', 'without a gap',
          'penalty left', 'bound')
BOUND = 0.05
DRIVE_S, RUN_S = '12', '20'
ATTEMPTS = 3
MOST_LOST = 0.01  # of the samples: of a run that the machine held up more, the error says nothing
# Nothing is compensated, and nothing learned, where the gap is told to be 0.
UNCOMPENSATED = {
    'estimator.law': 'fixed', 'estimator.initial.c_r': '0', 'estimator.initial.c_l': '0',
    'estimates.load': 'false',
}


@dataclass(frozen=True)
class Subject:
    """A driver. without_gap: a script that runs it with a backlash of no width."""

    name: str
    limits: Path
    gap: float
    without_gap: str


def subjects(folder: Path) -> list[Subject]:
    """The two example drivers; only the motor has its limits in a shipped file."""
    limits = folder / 'limits.yaml'
    limits.write_text(
        '/**: {ros__parameters: {sample_period: 0.01, '
        'control: {min: -10.0, max: 10.0, rate_max: 60.0}}}\n'
    )
    return [
        Subject(
            'motor_driver.py', ROOT / 'config' / 'limits.yaml', 0.9,
            'import simulated_motor, motor_driver\n'
            'simulated_motor.C_R = simulated_motor.C_L = 0.0\n'
            'motor_driver.main()\n',
        ),
        Subject(
            'bare_dds_driver.py', limits, 6.0,
            'import bare_dds_driver\n'
            'step = bare_dds_driver.Plant.step\n'
            'def direct(plant, v):\n'
            '    plant._u = 1.3 * v  # in the middle of its interval, where it stays\n'
            '    step(plant, v)\n'
            'bare_dds_driver.Plant.step = direct\n'
            'bare_dds_driver.main()\n',
        ),
    ]


def run(command: list[str], folder: Path, domain: int) -> None:
    """Run a command of a user; raises RuntimeError with what it said where it fails."""
    done = subprocess.run(
        command, env=_environment(folder, domain), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f'{shlex.join(command)}: {done.stdout}{done.stderr}')


def _environment(folder: Path, domain: int) -> dict[str, str]:
    environment = child_environment(folder, domain)
    paths = (str(EXAMPLES), str(ROOT), environment.get('PYTHONPATH', ''))
    return {**environment, 'PYTHONPATH': ':'.join(filter(None, paths))}


def identified(subject: Subject, folder: Path) -> float:
    """Let `identify --drive` move the driver; returns the gap that it found."""
    with free_domain() as domain:
        driver = subprocess.Popen(
            [sys.executable, str(EXAMPLES / subject.name)], env=_environment(folder, domain),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        )
        try:
            run([sys.executable, '-m', 'backlash_ros.tools.identify', '--drive',
                 '--config', str(subject.limits), '--duration', DRIVE_S,
                 '--out', str(folder / 'identified')], folder, domain)
        finally:
            driver.send_signal(signal.SIGINT)
            driver.wait()
    return float(json.loads((folder / 'identified' / 'identified.json').read_text())['gap'])


def tracking_error(
    folder: Path, name: str, driver: str, settings: Mapping[str, str],
) -> float:
    """Relative RMS of y - y_m over the last half of a run of `bringup --driver`."""
    for attempt in range(ATTEMPTS):
        out = folder / f'{name}_{attempt}'
        command = [sys.executable, '-m', 'backlash_ros.tools.bringup', '--config',
                   str(folder / 'identified' / 'identified.yaml'), '--driver', driver,
                   '--duration', RUN_S, '--out', str(out)]
        for key, value in settings.items():
            command += ['--set', f'{key}={value}']
        with free_domain() as domain:
            run(command, folder, domain)
        source = read_run(out)
        run_record = source.record
        if run_record.lost_samples <= MOST_LOST * run_record.samples:
            break
        print(f'{name}: {run_record.lost_samples} samples were lost', file=sys.stderr)
    else:
        raise RuntimeError(f'{name}: the machine is too busy for a driver to keep its time')
    assert source.parameters is not None
    delay = build_controller(source.parameters).structure.delay
    since = float(run_record.column('t')[run_record.samples // 2])
    error = delayed_tracking_error_rms(run_record, delay, since)
    assert error is not None
    return error


def measure(subject: Subject, folder: Path) -> list[str]:
    """One row of the table."""
    folder.mkdir()
    gap = identified(subject, folder)
    whole = shlex.join([sys.executable, str(EXAMPLES / subject.name)])
    script = folder / f'without_gap_{subject.name}'
    script.write_text(subject.without_gap)
    free = shlex.join([sys.executable, str(script)])
    learns = tracking_error(folder, 'compensated', whole, {})
    plain = tracking_error(folder, 'uncompensated', whole, UNCOMPENSATED)
    ideal = tracking_error(folder, 'without_gap', free, UNCOMPENSATED)
    penalty = (learns - ideal) / (plain - ideal)
    return [
        subject.name, f'{gap:.5g}', f'{subject.gap:g}',
        *(f'{100.0 * error:.3g} %' for error in (plain, learns, ideal)),
        f'{100.0 * penalty:.2g} %', f'{100.0 * BOUND:g} %',
    ]


def main() -> None:
    """Measure and print, or write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--write', action='store_true', help=f'write into {DOCUMENT.name}')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rows = [measure(subject, folder / str(k)) for k, subject in enumerate(subjects(folder))]
    print(text_table(HEADER, rows))
    if options.write:
        text = f'{markdown_table(HEADER, rows)}\n\nMeasured on {machine()}.\n'
        page = DOCUMENT.read_text()
        DOCUMENT.write_text(MARKS.sub(lambda found: found[1] + text + found[2], page))


if __name__ == '__main__':
    main()
