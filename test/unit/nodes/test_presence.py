"""Publishers of a command on this machine, known without the middleware."""

import os
from collections.abc import Iterator
from contextlib import closing

import pytest

from backlash_ros.nodes.control.rivals import LISTED, Presence

DOMAIN = os.getpid() + 1000  # of no ROS, so of nobody else

pytestmark = pytest.mark.skipif(not LISTED.exists(), reason='needs Linux')


@pytest.fixture
def here() -> Iterator[Presence]:
    with closing(Presence(DOMAIN, '/control', 'a')) as presence:
        yield presence


def test_a_publisher_of_the_same_topic_is_seen_until_it_lets_go(here: Presence) -> None:
    assert here.others() == frozenset()
    with closing(Presence(DOMAIN, '/control', 'b')) as other:
        assert here.others() == {'b'}
        assert other.others() == {'a'}
    assert here.others() == frozenset()


@pytest.mark.parametrize(('offset', 'topic'), [(1, '/control'), (0, '/x/control')])
def test_other_domains_and_topics_are_nobodys_business(here, offset, topic):
    with closing(Presence(DOMAIN + offset, topic, 'b')) as other:
        assert here.others() == other.others() == frozenset()
