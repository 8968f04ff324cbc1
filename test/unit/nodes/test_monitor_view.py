"""What `monitor` shows of a controller, without ROS and without a terminal."""

import re
import time
from io import StringIO

import pytest
from rich.console import Console

from backlash_ros.nodes.followed import ControllerState
from backlash_ros.nodes.monitor import screen

VALUES = {
    'state': 'tracking', 'm': '1.3', 'c_r': '3', 'c_l': '-3', 'std_m': '0.1', 'std_c_r': '0.2',
    'std_c_l': 'nan', 'samples': '1234', 'lost': '5', 'late': '6', 'learning': 'True',
    'compensating': 'False', 'excitation: swing of v / gap': '4.25', 'rate [Hz]': '99.97',
    'latency p50 [ms]': '0.912', 'latency p99 [ms]': '9.63'}
LONG = 'plant_output moves against v: reverse it, or the sign of plant.numerator, and so on ' * 2


def say(state, message, level=0, values=VALUES, silent_s=0.0):
    state.hear(message, level, {**values}, time.monotonic() - silent_s)


def controller(name='/controller', message='learned', level=0):
    state = ControllerState(name)
    say(state, message, level=level)
    return state


def shown(states: list[ControllerState], **changes: object) -> list[str]:
    console = Console(file=StringIO(), width=80, height=24, force_terminal=False)
    arguments = {'selected': 0, 'notice': '', 'height': 24, **changes}
    console.print(screen(states, **arguments))  # type: ignore[arg-type]
    assert isinstance(console.file, StringIO)
    return console.file.getvalue().rstrip('\n').split('\n')


def test_state_estimates_and_figures_are_shown() -> None:
    text = '\n'.join(shown([controller()]))
    for piece in (
        '/controller', 'tracking', '1.3 ± 0.2', '3 ± 0.4', '-3 ', '4.25 gaps', '99.97 Hz',
        'latency 0.912 ms, p99 9.63 ms', 'samples 1234', 'lost 5', 'late 6', 'learning',
        'not compensating', 'q quit'):
        assert piece in text, piece
    assert re.search(r'\d\d:\d\d:\d\d learned', text)
    assert 'Tab' not in text


@pytest.mark.parametrize('count', range(1, 9))
def test_any_number_of_controllers_fits_into_a_terminal(count: int) -> None:
    states = [controller(f'/axis_{i}/controller', LONG, level=2) for i in range(count)]
    for state in states:
        for i in range(30):
            state.note(f'event {"x" * i}')
    for selected in (0, count - 1):
        lines = shown(states, selected=selected, notice=LONG[:100])
        assert len(lines) <= 24
        assert all(len(line) <= 80 for line in lines)
        text = '\n'.join(lines)
        assert all(state.name in text for state in states)
        assert (f'> {states[selected].name}' in text) == (count > 1)


def test_a_text_in_which_only_figures_change_is_one_event() -> None:
    state = controller(message='9.38 % was lost')
    say(state, '8.1 % was lost', level=1)
    say(state, 'learned')
    assert [text for _, text in state.events] == ['9.38 % was lost', 'learned']
    assert state.message == 'learned'


def test_who_says_nothing_any_more_is_silent() -> None:
    state = controller()
    assert (state.word, state.level) == ('tracking', 0)
    say(state, 'learned', silent_s=7.2)
    assert (state.word, state.level) == ('silent for 7 s', 2)
    assert ControllerState('/controller').word == 'no diagnostics yet'


def test_an_inactive_controller_is_told_by_its_message() -> None:
    state = ControllerState('/controller')
    say(state, 'unconfigured', values={})
    assert state.word == 'unconfigured'
    assert any('unconfigured' in line for line in shown([state]))
    say(state, 'inactive: no control is published', values={'state': 'tracking'})
    assert state.word == 'inactive'
