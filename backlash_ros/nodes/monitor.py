"""Show running controllers in a terminal: state, estimates, excitation, latency, events.

Without a terminal, one line per controller is printed every second.
"""

import os
import re
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import isfinite
from typing import Any

from rclpy.client import Client
from rclpy.task import Future
from rich.console import Console, Group
from rich.layout import Layout
from rich.live import Live
from rich.panel import Panel
from rich.text import Text
from std_srvs.srv import SetBool, Trigger

from backlash_ros.nodes.followed import ControllerState, ViewerNode, viewer_options
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import run, split_arguments
from backlash_ros.options import print_any_text
from backlash_ros.topics import BACKLASH

SCREEN_PERIOD_S, NOTICE_S = 0.2, 3.0
# By key: the service, and the entry of /diagnostics that it toggles.
ACTIONS = {
    'f': ('freeze_adaptation', 'learning'), 'c': ('enable_compensation', 'compensating'),
    'r': ('reset_estimates', ''), 's': ('save_estimates', ''),
}
EXCITATION = 'excitation: swing of v / gap'  # entry of /diagnostics


class MonitorNode(ViewerNode):
    """Shows the wanted controllers and calls services of the selected one."""

    def __init__(self, wanted: Sequence[str]) -> None:
        super().__init__('monitor', wanted, BACKLASH)
        self._selected = 0
        self._notice, self._notice_ends_s, self._reset_ends_s = '', 0.0, 0.0
        self._client_of: dict[str, Client] = {}

    def work(self, executor: PromptExecutor) -> None:
        print_any_text()
        console = Console()
        if console.is_terminal and not console.is_dumb_terminal:
            self._show(executor, console)
        else:
            self.every(1.0, self._print_lines)
            super().work(executor)

    def _print_lines(self) -> None:
        self.take_messages()
        print('\n'.join(map(plain_line, self.states.values())) or self.awaited, flush=True)

    def _show(self, executor: PromptExecutor, console: Console) -> None:
        with pressed_keys() as keys, Live(
            console=console, screen=True, auto_refresh=False,
        ) as live:
            while not self.stopping:
                self.take_messages()
                for key in keys():
                    self._on_key(key)
                if time.monotonic() > self._notice_ends_s:
                    self._notice = '' if self.states else self.awaited
                live.update(screen(
                    [*self.states.values()], self._selected, self._notice, console.height,
                ), refresh=True)
                executor.spin_once(timeout_sec=SCREEN_PERIOD_S)

    def _on_key(self, key: str) -> None:
        now_s = time.monotonic()
        if key == 'q':
            signal.raise_signal(signal.SIGINT)
        elif self.states:
            state = [*self.states.values()][self._selected]
            if key == '\t':
                self._selected, self._reset_ends_s = (self._selected + 1) % len(self.states), 0.0
            elif key == 'r' and now_s > self._reset_ends_s:
                self._reset_ends_s = now_s + NOTICE_S
                self._say(f'press r once more to reset the estimates of {state.name}')
            elif key in ACTIONS:
                self._ask(state, *ACTIONS[key])

    def _say(self, text: str) -> None:
        self._notice, self._notice_ends_s = text, time.monotonic() + NOTICE_S

    def _ask(self, state: ControllerState, service: str, switch: str) -> None:
        """Call a service; its answer is noted as an event."""
        name, on = f'{state.node}/{service}', not state.is_on(switch)
        request: Any = Trigger.Request()
        if switch:
            request = SetBool.Request(data=on if service == 'enable_compensation' else not on)
        if name not in self._client_of:
            self._client_of[name] = self.create_client(SetBool if switch else Trigger, name)
        if not self._client_of[name].wait_for_service(2.0):
            self._say(f'{name} is not there')
            return

        def take(answer: Future) -> None:
            response = answer.result()
            state.note(response.message)
            self._say(f'{state.name}: {response.message}')
            if switch and response.success:
                state.values[switch] = str(on)  # the next diagnostics may be a second away

        self._say(f'{name} is asked')
        self._client_of[name].call_async(request).add_done_callback(take)


def screen(
    states: Sequence[ControllerState], selected: int, notice: str, height: int,
) -> Layout:
    """All controllers; if there is no room, those not selected get a line each."""
    several, footer_lines, panel_lines = len(states) > 1, 2, 10
    every = len(states) * panel_lines <= height - footer_lines
    rows = [
        Layout(_panel(state, several and i == selected)) if every or i == selected
        else Layout(_lines(plain_line(state)), size=1) for i, state in enumerate(states)
    ]
    keys = 'f freeze/learn  c compensate  r reset  s save  q quit'
    footer = Text(notice, 'bold') if notice else Text('Tab next  ' * several + keys, 'dim')
    layout = Layout()
    layout.split_column(*rows, Layout(footer, size=footer_lines))
    return layout


def _lines(*lines: str, style: str = '') -> Text:
    return Text('\n'.join(lines), style, no_wrap=True, overflow='crop')


def plain_line(state: ControllerState) -> str:
    known = [name for name in BACKLASH if isfinite(state.estimates[name][0])]
    parts = [f'{state.name}: {state.word}',
             ', '.join(f'{name} {_with_band(state, name)}' for name in known)]
    if 'samples' in state.values:
        parts.append(f'excitation {state.number(EXCITATION):.3g}, latency '
                     f'{state.number("latency p50 [ms]"):.3g} ms, lost {state.values.get("lost")}')
    return '; '.join(filter(None, parts))


def _panel(state: ControllerState, chosen: bool) -> Panel:
    values, number = state.values, state.number
    colour = ('green', 'yellow', 'red')[state.level]
    lines = [f'{name:<4}{_with_band(state, name, 11)}' for name in BACKLASH]
    if 'samples' in values:
        lines += [
            f'excitation {number(EXCITATION):.3g} gaps   {number("rate [Hz]"):.4g} Hz   latency '
            f'{number("latency p50 [ms]"):.3g} ms, p99 {number("latency p99 [ms]"):.3g} ms',
            f'samples {values["samples"]}   lost {values.get("lost", "?")}   late '
            f'{values.get("late", "?")}   {"learning" if state.is_on("learning") else "frozen"}, '
            f'{"" if state.is_on("compensating") else "not "}compensating',
        ]
    return Panel(
        Group(
            _lines(state.word, style=f'bold {colour}'), _lines(*lines), Text(state.message),
            _lines(*map(' '.join, reversed(state.events)), style='dim'),
        ), title=f'> {state.name}' if chosen else state.name, title_align='left',
        border_style='bold' if chosen else 'dim',
    )


def _with_band(state: ControllerState, name: str, width: int = 0) -> str:
    value, half = state.estimates[name]
    return f'{value:>{width}.5g}' + (f' ± {half:.2g}' if isfinite(half) else '')


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Yield a function that returns the keys pressed on the terminal since its last call."""
    if not sys.stdin.isatty():
        yield lambda: ''
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def read() -> str:
        if not select.select([descriptor], [], [], 0.0)[0]:
            return ''
        text = os.read(descriptor, 100).decode(errors='ignore')
        # Arrows and function keys come as sequences, parts of which look like other keys.
        return re.sub(r'\x1b(\[|O)[0-9;]*.?', '', text)

    try:
        tty.setcbreak(descriptor)
        yield read
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def main(args: list[str] | None = None) -> int:
    plain, of_ros = split_arguments(args)
    options = viewer_options(
        'monitor', __doc__, 'keys: f freezes or resumes learning, c turns compensation on or off, '
        'r (twice) resets\n      the estimates, s saves them, Tab selects the next one, q quits.',
    ).parse_args(plain)
    return run('monitor', lambda: MonitorNode(options.name), of_ros)


if __name__ == '__main__':
    sys.exit(main())
