"""Who of several publishers of the command was first, and who is gone."""

from typing import Any

import pytest

from backlash_ros.nodes.control.rivals import ENDPOINT, SINCE, Rival, Rivals
from backlash_ros.nodes.runtime.messages import SILENT_S


def rivals_of(own: str = 'b', active_at: float = 10.0, since_ns: int = 100) -> Rivals:
    rivals = Rivals(own, settled_at=5.0)
    rivals.begin(since_ns, active_at)
    return rivals


def claim(identity: str, since_ns: int) -> dict[str, Any]:
    return {ENDPOINT: identity, SINCE: str(since_ns)}


@pytest.mark.parametrize(('identity', 'since_ns', 'was_first'), [
    ('x', 99, True), ('x', 101, False), ('a', 100, True), ('c', 100, False),
])
def test_the_time_of_activation_decides_and_the_identity_where_it_is_equal(
    identity: str, since_ns: int, was_first: bool,
) -> None:
    rivals = rivals_of()
    rivals.hear(claim(identity, since_ns), 10.0)
    rivals.among({identity: '/other'}, 10.0)
    rivals.hear(claim(identity, since_ns), 10.5)
    assert rivals.among({identity: '/other'}, 11.0) == (Rival('/other', was_first),)


def test_without_a_word_presence_at_activation_decides() -> None:
    rivals = rivals_of(active_at=10.0)
    rivals.among({'x': '/early'}, 9.0)
    found = rivals.among({'x': '/early', 'y': '/late'}, 11.0)
    assert found == (Rival('/early', True), Rival('/late', False))


def test_a_controller_that_says_nothing_any_more_is_gone_though_discovery_still_has_it() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 50), 10.0)
    assert rivals.among({'x': '/other'}, 10.0 + 0.9 * SILENT_S) == (Rival('/other', True),)
    assert rivals.among({'x': '/other'}, 10.0 + 1.1 * SILENT_S) == ()


def test_who_is_inactive_has_no_rivals_and_is_none() -> None:
    rivals = rivals_of()
    rivals.among({'x': '/other'}, 9.0)
    rivals.hear(claim('x', 0), 10.0)
    assert rivals.among({'x': '/other'}, 10.1) == ()
    rivals.hear(claim('x', 50), 10.2)
    assert rivals.among({'x': '/other'}, 10.3) == (Rival('/other', True),)
    rivals.begin(0, 10.35)
    assert rivals.among({'x': '/other'}, 10.4) == ()
