"""Node that judges a driver: it listens, moves it gently if told to, and says what does not fit."""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
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
        period = self.settings.sample_period
        record = timing_of(self.heard, period).record
        if record is None:
            self.say(f'nothing to save in {path}: v and y were not both heard')
            return
        rows = np.column_stack([period * np.arange(len(record[0])), *record])
        try:
            np.savetxt(path, rows, '%.12g', ',', header='t,v,y', comments='')
            print(f'saved {len(rows)} samples of v and y in {path}')
        except OSError as error:
            self.say(f'{path}: cannot be written: {error.strerror}')


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


def main(args: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    plain, given = split_arguments(args)
    options, files = parse_options(plain), list[Path]()
    with tempfile.TemporaryDirectory() as folder:
        if options.config is not None:
            files = [find_config(Path(options.config))]
            # What it holds for the controller alone. Of a broken file rcl says what is wrong.
            with suppress(OSError, UnicodeDecodeError, yaml.YAMLError, TypeError):
                document = yaml.safe_load(files[0].read_text(encoding='utf-8'))
                for section in ('/**/controller', 'controller', '/controller'):
                    if section in document:
                        path = Path(folder) / f'{len(files)}.yaml'
                        path.write_text(yaml.safe_dump({'/**': document[section]}))
                        files.append(path)
        for file in reversed(files):
            given = ['--ros-args', '--params-file', str(file), *given]
        return run('check_driver', lambda: CheckDriverNode('check_driver', options, waves), given)


if __name__ == '__main__':
    sys.exit(main())
