"""Node that judges a driver: it listens, moves it gently if told to, and says what does not fit."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml

from backlash_ros.core.driver_check import WRONG, Judgement, all_fit, judge, table, timing_of
from backlash_ros.core.identification.motion import waves
from backlash_ros.nodes.drive import MotionNode
from backlash_ros.nodes.runtime.process import run, split_arguments
from backlash_ros.options import DONE, FAILED, OptionParser, add_motion_options, find_config


class CheckDriverNode(MotionNode):
    """Judges what it hears."""

    def tell(self) -> None:
        findings = judge(self.graph.in_the_end(), self.heard, self.settings)
        if self.ended:
            findings.append(Judgement(
                'drive', WRONG, f'{self.ended}: drive ended',
                'let y come all the time; widen --output-range, or drive less: --amplitude, --rate',
            ))
        print(table(findings), flush=True)
        if self.options.save is not None:
            self._save(self.options.save)
        self.exit_code = DONE if all_fit(findings) else FAILED

    def _save(self, path: Path) -> None:
        record = timing_of(self.heard, self.settings.sample_period).record
        if record is None:
            self.say(f'nothing to save in {path}: v and y were not both heard')
            return
        v, y = record
        rows = np.column_stack([self.settings.sample_period * np.arange(len(v)), v, y])
        try:
            np.savetxt(path, rows, '%.12g', ',', header='t,v,y', comments='')
        except OSError as error:
            self.say(f'{path}: cannot be written: {error.strerror}')
            return
        print(f'saved {len(v)} samples of v and y in {path}')


def parse_options(plain: Sequence[str]) -> argparse.Namespace:
    parser = OptionParser('check_driver', description=__doc__,
                          epilog='Exit codes: 0 all fits, 1 something does not, 2 bad input.')
    parser.add_argument('--config', metavar='FILE', help='ROS 2 parameter file of the controller, '
                        'or the name of a shipped one')
    parser.add_argument('--drive', action='store_true', help='move v, to and fro within '
                        'the limits of control, to rest at the end')
    parser.add_argument('--save', type=Path, metavar='FILE', help='write t,v,y as CSV')
    add_motion_options(parser, 10.0, 'how long to listen')
    options = parser.parse_args(plain)
    for name in ('amplitude', 'rate'):
        if getattr(options, name) is not None and not options.drive:
            parser.error(f'--{name} says how to drive: give --drive as well')
    return options


def _parameter_files(config: str, folder: Path) -> list[str]:
    """The file, and in folder one more with what it holds for the controller alone, if anything."""
    try:
        document = yaml.safe_load(Path(config).read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return [config]  # rcl says what is wrong with it
    files = [config]
    for section in ('/**/controller', 'controller', '/controller'):
        if isinstance(document, dict) and section in document:
            path = folder / f'{len(files)}.yaml'
            path.write_text(yaml.safe_dump({'/**': document[section]}), encoding='utf-8')
            files.append(str(path))
    return files


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    plain, given = split_arguments(args)
    options = parse_options(plain)
    with tempfile.TemporaryDirectory() as folder:
        if options.config is not None:
            config = str(find_config(Path(options.config)))
            for file in reversed(_parameter_files(config, Path(folder))):
                given = ['--ros-args', '--params-file', file, *given]
        return run('check_driver', lambda: CheckDriverNode('check_driver', options, waves), given)


if __name__ == '__main__':
    sys.exit(main())
