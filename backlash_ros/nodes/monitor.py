"""Shows running controllers in a terminal: state, estimates, excitation, latency, what happens.

Without a terminal a line per controller is printed once a second.
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
from io import TextIOWrapper
from math import isfinite
from textwrap import wrap
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.text import Text
from std_srvs.srv import SetBool, Trigger

from backlash_ros.nodes import followed
from backlash_ros.nodes.followed import ControllerState
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ProcessNode, run, split_arguments
from backlash_ros.topics import BACKLASH

SCREEN_PERIOD_S = 0.2
# By key: the service, and the switch of the diagnostics that it turns over.
ACTIONS = {
    'f': ('freeze_adaptation', 'learning'), 'c': ('enable_compensation', 'compensating'),
    'r': ('reset_estimates', ''), 's': ('save_estimates', ''),
}


class MonitorNode(ProcessNode):
    """Shows the controllers that are wanted, as FollowedControllers knows them."""

    def __init__(self, wanted: Sequence[str]) -> None:
        super().__init__('monitor')
        self._followed = followed.FollowedControllers(self, wanted, BACKLASH, depth=1)
        self._selected = 0
        self._notice, self._notice_ends_s = '', 0.0

    def work(self, executor: PromptExecutor) -> None:
        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(errors='replace')  # whatever a terminal cannot show
        console = Console()
        try:
            if console.is_terminal and not console.is_dumb_terminal:
                self._show(executor, console)
            else:
                self._print_lines(executor)
        except BrokenPipeError:
            # Python would complain of it once more when it flushes at its end.
            sys.stdout = open('/dev/null', 'w')  # noqa: SIM115

    def _states(self) -> list[ControllerState]:
        self._followed.take_messages()
        return list(self._followed.by_name.values())

    def _show(self, executor: PromptExecutor, console: Console) -> None:
        with pressed_keys() as keys, Live(
            console=console, screen=True, auto_refresh=False, redirect_stdout=False,
            redirect_stderr=False,
        ) as live:
            while not self.stopping:
                states, now_s = self._states(), time.monotonic()
                if now_s > self._notice_ends_s:
                    self._notice = '' if states else self._followed.awaited
                live.update(screen(
                    states, self._selected, self._notice, now_s, console.width, console.height,
                ), refresh=True)
                pressed = ''
                while not (pressed or self.stopping or time.monotonic() > now_s + SCREEN_PERIOD_S):
                    executor.spin_once(timeout_sec=SCREEN_PERIOD_S / 4)
                    pressed = keys()
                for key in pressed:
                    if key == 'q':
                        signal.raise_signal(signal.SIGINT)
                    elif states:
                        self._on_key(key, executor, states)

    def _print_lines(self, executor: PromptExecutor) -> None:
        due_s = time.monotonic() + 1.0
        while not self.stopping:
            executor.spin_once(timeout_sec=SCREEN_PERIOD_S)
            if time.monotonic() >= due_s:
                due_s += 1.0
                lines = [plain_line(state, time.monotonic()) for state in self._states()]
                print('\n'.join(lines) or self._followed.awaited, flush=True)

    def _on_key(self, key: str, executor: PromptExecutor, states: list[ControllerState]) -> None:
        state = states[self._selected]
        asked = f'press r once more to reset the estimates of {state.name}'
        if key == '\t':
            self._selected, self._notice = (self._selected + 1) % len(states), ''
        elif key == 'r' and self._notice != asked:
            self._say(asked)
        elif key in ACTIONS:
            text = self._answer_of(executor, state, *ACTIONS[key])
            state.note(text)
            self._say(f'{state.name}: {text}')

    def _say(self, text: str) -> None:
        self._notice, self._notice_ends_s = text, time.monotonic() + 3.0

    def _answer_of(
        self, executor: PromptExecutor, state: ControllerState, service: str, switch: str,
    ) -> str:
        """What a service answers, or why it does not; the screen waits so long."""
        name, on, patience_s = f'{state.node}/{service}', not state.is_on(switch), 2.0
        request: Any = Trigger.Request()
        if switch:
            request = SetBool.Request(data=on if service == 'enable_compensation' else not on)
        client = self.create_client(SetBool if switch else Trigger, name)
        try:
            if not client.wait_for_service(patience_s):
                return f'{name} is not there'
            until_s, answer = time.monotonic() + patience_s, client.call_async(request)
            while not (answer.done() or self.stopping or time.monotonic() > until_s):
                executor.spin_once(timeout_sec=SCREEN_PERIOD_S / 4)
            response = answer.result()
            if response is None:
                return f'no answer within {patience_s:g} s'
            if switch and response.success:
                state.values[switch] = str(on)  # the next diagnostics may be a second away
            return str(response.message)
        finally:
            self.destroy_client(client)


def screen(
    states: Sequence[ControllerState], selected: int, notice: str, now_s: float, width: int,
    height: int,
) -> Group:
    """All controllers; where there is no room, all but the selected one in a line each."""
    panel_lines = 10  # lines of a controller without events, its frame included
    several = len(states) > 1
    keys = 'f freeze/learn  c compensate  r reset  s save  q quit'
    below = wrap(notice or ('Tab next  ' if several else '') + keys, width)
    room = height - len(below)
    every = len(states) * panel_lines <= room
    long = room // max(len(states), 1) if every else room - (len(states) - 1)
    return Group(*(
        _panel(state, now_s, width, long - panel_lines, several and i == selected)
        if every or i == selected else _cropped(plain_line(state, now_s))
        for i, state in enumerate(states)
    ), *(_cropped((line, 'bold' if notice else 'dim')) for line in below))


def _cropped(*parts: str | tuple[str, str]) -> Text:
    return Text.assemble(*parts, no_wrap=True, overflow='crop')


def plain_line(state: ControllerState, now_s: float) -> str:
    known = [name for name in BACKLASH if isfinite(state.estimates[name][0])]
    parts = [f'{state.name}: {state.word(now_s)}',
             ', '.join(f'{name} {_with_band(state, name)}' for name in known)]
    if 'samples' in state.values:
        parts.append(f'excitation {state.excitation:.3g}, latency '
                     f'{state.number("latency p50 [ms]"):.3g} ms, lost {state.values.get("lost")}')
    return '; '.join(filter(None, parts))


def _panel(
    state: ControllerState, now_s: float, width: int, events: int, chosen: bool,
) -> Panel:
    inner, values, number = width - 4, state.values, state.number
    colour = 'red' if state.silent_s(now_s) else ('green', 'yellow', 'red')[state.level]
    # Often the cure stands in the second line.
    lines = [*wrap(state.message, inner), '', ''][:2]
    lines += [f'{name:<4}{_with_band(state, name, 11)}' for name in BACKLASH]
    lines += [
        f'excitation {state.excitation:.3g} gaps   {number("rate [Hz]"):.4g} Hz   '
        f'latency {number("latency p50 [ms]"):.3g} ms, p99 {number("latency p99 [ms]"):.3g} ms',
        f'samples {values["samples"]}   lost {values.get("lost", "?")}   late '
        f'{values.get("late", "?")}   {"learning" if state.is_on("learning") else "frozen"}, '
        f'{"" if state.is_on("compensating") else "not "}compensating',
    ] if 'samples' in values else ['', '']
    newest = list(state.events)[max(len(state.events) - events, 0):]
    text = _cropped(
        (state.word(now_s), f'bold {colour}'), *(f'\n{line}' for line in lines),
        *((f'\n{clock} {event}'[:inner + 1], 'dim') for clock, event in newest),
    )
    return Panel(
        text, title=f'> {state.name}' if chosen else state.name, title_align='left', width=width,
        border_style='bold' if chosen else 'dim',
    )


def _with_band(state: ControllerState, name: str, width: int = 0) -> str:
    value, half = state.estimates[name]
    return f'{value:>{width}.5g}' + (f' ± {half:.2g}' if isfinite(half) else '')


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """A function that returns what was pressed since its last call, on a terminal."""
    if not sys.stdin.isatty():
        yield lambda: ''
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def read() -> str:
        if not select.select([descriptor], [], [], 0.0)[0]:
            return ''
        text = os.read(descriptor, 100).decode(errors='ignore')
        # Arrows and function keys come as sequences of which a part looks like other keys.
        return re.sub(r'\x1b(\[|O)[0-9;]*.?', '', text)

    try:
        tty.setcbreak(descriptor)
        yield read
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def main(args: list[str] | None = None) -> int:
    plain, of_ros = split_arguments(args)
    options = followed.viewer_options(
        'monitor', __doc__, 'keys: f freezes or goes on learning, c compensates or not, r (twice) '
        'resets the estimates,\n      s saves them, Tab takes the next controller, q ends.',
    ).parse_args(plain)
    followed.give_way()
    return run('monitor', lambda: MonitorNode(options.name), of_ros)


if __name__ == '__main__':
    sys.exit(main())
