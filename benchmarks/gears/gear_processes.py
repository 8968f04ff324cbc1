"""Gears made of physics with the commands of a user: real processes over DDS, in real time.

`identify --drive` with nothing but the limits of the preset, then `bringup --driver` with the file
that it wrote, as it is.
"""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
from reporting import ROOT

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.metrics import delayed_reference
from backlash_ros.tools.bringup.environment import child_environment, free_domain
from backlash_ros.tools.config import effective_parameters
from backlash_ros.tools.runs.source import read_run
from gears.gear_runs import (
    AT_FIRST,
    ATTEMPTS,
    FIRST,
    MOTIONS,
    PERIODS,
    PRESETS,
    SLOWER,
    told,
)

DRIVER = ROOT / 'examples' / 'mujoco_gear.py'
MOTION = 'sine'
DRIVE_S = 20.0  # of the motion for identification
DRIVES, MOST_LOST = 2, 0.02  # motions; share of lost samples from which on there is another one
NONE = {
    'estimator.law': 'fixed', 'fixed.doubt': '0.5', 'estimator.initial.c_r': '0',
    'estimator.initial.c_l': '0', 'estimates.load': 'false',
}
LEAST = 0.005  # share of a state that is told
COUNTS = re.compile(r'([a-z][a-z -]*): (\d+)')


class TooBusyError(RuntimeError):
    """The machine does not leave the driver the time that it needs."""


class GearProcesses:
    """One preset, with settings as `--set` takes them, and the folder of all that is written.

    told: what `identify` had to be told, if anything.
    """

    def __init__(self, preset: str, folder: Path, *settings: str) -> None:
        self.gear, self._folder = PRESETS[preset].with_settings(list(settings)), folder
        self.told = ''
        self._limits, self._found = folder / 'limits.yaml', folder / 'identified'
        self._driver = [sys.executable, str(DRIVER), '--preset', preset]
        for setting in settings:
            self._driver += ['--set', setting]
        self._limits.write_text(self._run([*self._driver, '--limits'], 0).stdout)

    @property
    def parameters(self) -> Parameters:
        """The identified file as it is."""
        return effective_parameters(self._found / 'identified.yaml')

    def identify(self, seconds: float = DRIVE_S) -> dict[str, Any]:
        """Let `identify --drive` move the gear; return what it wrote to identified.json.

        Where that is of no use, identify the record again with ATTEMPTS, then move more slowly.
        Raises RuntimeError where a command did not get so far, TooBusyError where each motion lost
        too many samples.
        """
        record = self._folder / 'record.csv'
        for share, longer in (AT_FIRST, *SLOWER):
            self._move(longer * seconds, share)
            (self._found / 'record.csv').replace(record)
            for option in ATTEMPTS:
                self.told = told(share, option)
                if option:
                    self._identify([str(record), *option.split()], 0)
                found = self._said()
                if found['usable']:
                    return found
        return found

    def _move(self, seconds: float, share: float) -> None:
        """Move at this share of the rate, once more where too many samples were lost."""
        for _ in range(DRIVES):
            self._drive(seconds, share)
            found = self._said()
            if found['lost_samples'] <= MOST_LOST * found['samples']:
                return
        raise TooBusyError(f'{found["lost_samples"]} of {found["samples"]} samples were lost')

    def follow(
        self, name: str, settings: Mapping[str, str] | None = None, periods: int = PERIODS,
    ) -> Followed:
        """Let `bringup --driver` follow so many periods of the sine of the preset."""
        gear, out = self.gear, self._folder / name
        frequency = MOTIONS[MOTION][1] * gear.frequency
        duration = gear.sample_period * round(periods / frequency / gear.sample_period)
        command = ['bringup', '--config', str(self._found / 'identified.yaml'), '--driver',
                   shlex.join(self._driver), '--duration', f'{duration:.9g}',
                   '--out', str(out)]
        for key, value in {
            'waveform': 'sine', 'amplitude': f'{gear.scale * gear.swing:g}',
            'frequency': f'{2.0 * pi * frequency:.9g}', 'bias': '0', **(settings or {}),
        }.items():
            command += ['--set', f'{key}={value}']
        with free_domain() as domain:
            self._tool(command, domain, (0,))
        source = read_run(out)
        assert source.parameters is not None
        record, delay = source.record, build_controller(source.parameters).structure.delay
        late = record.column('t') >= FIRST / frequency
        error = (record.column('y') - delayed_reference(record, delay))[late]
        summary = json.loads((out / 'summary.json').read_text())
        counts = dict(COUNTS.findall((out / 'logs' / 'controller.log').read_text()))
        samples = int(counts.get('samples', summary['samples']))
        return Followed(
            float(np.sqrt(np.mean(error**2))), summary['final']['c_r'] - summary['final']['c_l'],
            {word: share for word, share in summary['status_share'].items() if share},
            int(counts.get('late', 0)) / samples, int(counts.get('lost', 0)) / samples,
        )

    def _drive(self, seconds: float, share: float) -> None:
        rate = share * self.gear.scale * self.gear.rate
        with free_domain() as domain:
            driver = subprocess.Popen(
                self._driver, env=self._environment(domain), stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
            try:
                self._identify(
                    ['--drive', '--duration', f'{seconds:g}', '--rate', f'{rate:.6g}'], domain
                )
            finally:
                driver.send_signal(signal.SIGINT)
                driver.wait()

    def _said(self) -> dict[str, Any]:
        return dict(json.loads((self._found / 'identified.json').read_text()))

    def _identify(self, arguments: list[str], domain: int) -> None:
        self._tool(['identify', *arguments, '--config', str(self._limits),
                    '--out', str(self._found)], domain, (0, 1))

    def _tool(self, words: list[str], domain: int, codes: tuple[int, ...]) -> None:
        name, *arguments = words
        done = self._run([sys.executable, '-m', f'backlash_ros.tools.{name}', *arguments], domain)
        if done.returncode not in codes:
            raise RuntimeError(f'{shlex.join(words)}: {done.stdout}{done.stderr}')

    def _run(self, command: list[str], domain: int) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command, env=self._environment(domain), capture_output=True, text=True, check=False
        )

    def _environment(self, domain: int) -> dict[str, str]:
        environment = child_environment(self._folder, domain)
        paths = (str(ROOT), environment.get('PYTHONPATH', ''))
        return {**environment, 'PYTHONPATH': ':'.join(filter(None, paths))}


@dataclass(frozen=True)
class Followed:
    """A run. error: RMS of y - y_m from the period FIRST on. late, lost: shares of the samples."""

    error: float
    gap: float
    states: dict[str, float]
    late: float
    lost: float


HEADER = ('preset', 'sample period', 'gap identified / lost motion', 'gap at the end', 'none',
          'error', 'removed', 'states', 'late', 'lost')


def process_row(preset: str) -> list[str]:
    """A line of the table; errors in % of the lost motion."""
    gear, lost = PRESETS[preset], PRESETS[preset].lost_motion
    with tempfile.TemporaryDirectory() as name:
        processes = GearProcesses(preset, Path(name))
        try:
            found = processes.identify()
        except TooBusyError as error:
            return [preset, f'{1e3 * gear.sample_period:g} ms', *[''] * 6, str(error), '', '']
        options = f' ({processes.told})' if processes.told else ''
        row = [preset, f'{1e3 * gear.sample_period:g} ms', f'{found["gap"] / lost:.3f}{options}']
        if not found['usable']:
            return [*row, '', '', '', '', '', f'identify: {"; ".join(found["reasons"])}', '', '']
        learned, none = processes.follow('learned'), processes.follow('none', NONE)
    removed = (none.error - learned.error) / none.error
    states = sorted(learned.states.items(), key=lambda item: -item[1])
    return [
        *row, f'{learned.gap / lost:.3f}',
        *(f'{one / lost:.1%}' for one in (none.error, learned.error)), f'{removed:.0%}',
        ', '.join(f'{word} {share:.0%}' for word, share in states if share >= LEAST),
        f'{learned.late:.2%}', f'{learned.lost:.2%}',
    ]
