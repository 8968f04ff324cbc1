"""How controllers look in a terminal of 80 columns, and as plain lines."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, isnan
from textwrap import wrap

from rich.console import Group
from rich.panel import Panel
from rich.text import Text

from backlash_ros.nodes.watching.followed import ControllerState
from backlash_ros.topics import BACKLASH

# Sure, within the band, beyond it.
BAR, ASCII_BAR = '█▒·', '#=.'


def bar(value: float, half_width: float, scale: float, width: int, blocks: str = BAR) -> str:
    """A bar from 0 to |value| on an axis that ends at `scale`, its band in another shade.

    Empty where value or scale is nothing to draw. A band that is there takes a column at least.
    """
    if not isfinite(value) or not scale > 0.0:
        return ' ' * width
    half = 0.0 if isnan(half_width) else half_width
    begins, ends = (
        round(width * min(max(x / scale, 0.0), 1.0)) for x in (abs(value) - half, abs(value) + half)
    )
    if half > 0.0 and begins == ends:
        begins = max(begins - 1, 0)
        ends = begins + 1
    return blocks[0] * begins + blocks[1] * (ends - begins) + blocks[2] * (width - ends)


def axis_end(largest: float) -> float:
    """The next of 1, 2, 5, 10, 20, ... above 1.1 times the largest magnitude; 0 without one."""
    wanted = 1.1 * largest
    if not wanted > 0.0:
        return 0.0
    power = 10.0 ** int(f'{wanted:e}'.partition('e')[2])
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= wanted)


def screen(
    states: Sequence[ControllerState], selected: int, notice: str, now_s: float,
    width: int, height: int, blocks: str = BAR,
) -> Group:
    """All controllers; where there is no room, all but the selected one in a line each.

    notice: in place of the keys. now_s: on the steady clock. width, height: of the terminal.
    """
    panel_lines = 10  # lines of a controller without events, its frame included
    keys = 'f freeze/learn  c compensate  r reset  s save  q quit'
    several = len(states) > 1
    below = wrap(notice or ('Tab next  ' if several else '') + keys, width)
    room = height - len(below)
    every = len(states) * panel_lines <= room
    long = room // max(len(states), 1) if every else room - (len(states) - 1)
    parts: list[Panel | Text] = []
    for i, state in enumerate(states):
        if every or i == selected:
            chosen = several and i == selected
            parts.append(_panel(state, now_s, width, long - panel_lines, chosen, blocks))
        else:
            parts.append(_cropped(plain_line(state, now_s)[:width]))
    parts += [_cropped(line, style='bold' if notice else 'dim') for line in below]
    return Group(*parts)


def plain_line(state: ControllerState, now_s: float) -> str:
    """One controller in a line."""
    parts = [f'{state.name}: {state.word(now_s)}', ', '.join(
        f'{name} {_with_band(state, name)}' for name in BACKLASH
        if isfinite(state.estimates[name][0])
    )]
    if 'samples' in state.values:
        parts.append(
            f'excitation {state.excitation:.3g}, '
            f'latency {state.number("latency p50 [ms]"):.3g} ms, lost {state.values.get("lost")}'
        )
    return '; '.join(part for part in parts if part)


def _panel(
    state: ControllerState, now_s: float, width: int, events: int, chosen: bool, blocks: str,
) -> Panel:
    """One controller in a frame. events: how many of the newest ones."""
    inner = width - 4
    colour = 'red' if state.silent_s(now_s) else ('green', 'yellow', 'red')[state.level]
    text = Text(no_wrap=True, overflow='crop')
    text.append(state.word(now_s), style=f'bold {colour}')
    # Often the cure stands in the second line.
    for line in [*wrap(state.message, inner), '', ''][:2]:
        text.append('\n' + line)
    for name in BACKLASH:
        text.append('\n' + _estimate_line(state, name, inner, blocks))
    text.append('\n' + _figures(state))
    for clock, event in list(state.events)[max(len(state.events) - events, 0):]:
        text.append(f'\n{clock} {event}'[:inner + 1], style='dim')
    return Panel(
        text, title=f'> {state.name}' if chosen else state.name, title_align='left', width=width,
        border_style='bold' if chosen else 'dim',
    )


def _estimate_line(state: ControllerState, name: str, width: int, blocks: str) -> str:
    """One estimate: value, half width of its band, bar, end of its axis."""
    value, half = state.estimates[name]
    end = axis_end(state.scales[name])
    axis = f' {"-" if name == "c_l" else ""}{end:g}'
    before = f'{f"{name:<4}{_with_band(state, name, 11)}":<32}'
    drawn = bar(value, half, end, max(width - len(before) - len(axis), 0), blocks)
    return f'{before}{drawn}{axis if end else ""}'


def _with_band(state: ControllerState, name: str, width: int = 0) -> str:
    value, half = state.estimates[name]
    return f'{value:>{width}.5g}' + (f' ± {half:.2g}' if isfinite(half) else '')


def _figures(state: ControllerState) -> str:
    """Excitation, times and counts, in two lines."""
    values, number = state.values, state.number
    if 'samples' not in values:
        return '\n'
    return (
        f'excitation {state.excitation:.3g} gaps   {number("rate [Hz]"):.4g} Hz   '
        f'latency {number("latency p50 [ms]"):.3g} ms, p99 {number("latency p99 [ms]"):.3g} ms\n'
        f'samples {values["samples"]}   lost {values.get("lost", "?")}   '
        f'late {values.get("late", "?")}   {"learning" if state.is_on("learning") else "frozen"}, '
        f'{"" if state.is_on("compensating") else "not "}compensating'
    )


def _cropped(line: str, style: str = '') -> Text:
    return Text(line, no_wrap=True, overflow='crop', style=style)
