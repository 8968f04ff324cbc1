"""`live` without a browser: what it sends, to whom, and what it does to a run."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from bringup_processes import Session, bringup_sessions, wait_until
from live_pages import address_of, frames, listening_addresses
from ros_processes import ros_world

from backlash_ros.nodes.live import LIVE_LABELS

MODULE = 'live'


@pytest.fixture(scope='module')
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with bringup_sessions(tmp_path_factory.mktemp('live')) as start_session:
        session = start_session(
            '--config', 'two_axes.yaml', '--duration', 'inf', '--no-record', '--live',
            '--set', 'estimator.law=lms',
        )
        address_of(session)
        session.wait_for_samples('pan')
        yield session


def test_alone_it_waits_for_a_controller_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        world.forked = False
        del world.environment['BACKLASH_ROS_EVENTS']
        live = world.start(MODULE, None, '/pan')
        wait_until(lambda: live.stdout.endswith('\n'), 'the address')

        state = next(frames(live.stdout.strip()))['state']
        assert f'of /pan in ROS_DOMAIN_ID={world.domain}' in state['awaited']
        port = live.stdout.strip().rpartition(':')[2]
        taken = world.start(MODULE, None, '--port', port)
        assert taken.wait() == 2
        assert taken.stderr.startswith(f'live: --port={port}: Address already in use')
        assert (len(taken.stderr.splitlines()), live.stop(), live.stderr) == (1, 0, '')


def test_a_page_shows_every_axis_to_this_machine_alone_and_a_run_goes_on_without_it(run):
    heard: dict[str, set[str]] = {}
    for frame in frames(address_of(run)):
        for portion in frame['portions']:
            for name, curves in portion.items():
                heard.setdefault(name, set()).update(curves)
        complete = [labels for labels in heard.values() if set(LIVE_LABELS) <= labels]
        if len(complete) == 2 and all(
            each['values'].get('rate [Hz]') for each in frame['state']['controllers']
        ):
            break
    assert set(heard) == {'/pan/controller', '/tilt/controller'}
    assert [each['name'] for each in frame['state']['controllers']] == sorted(heard)
    for state in frame['state']['controllers']:
        assert state['word']
        assert int(state['values']['samples']) > 0
        assert set(state['estimates']) == {'m', 'c_r', 'c_l'}
        assert state['events']
    assert listening_addresses(run.node('live')) == {'127.0.0.1'}
    with pytest.raises(HTTPError, match=r'only 127\.0\.0\.1 is served'):
        urlopen(Request(address_of(run), headers={'Host': 'elsewhere.example'}))
    os.kill(run.node('live'), signal.SIGKILL)
    said = 'live died (killed by SIGKILL), the run goes on without it'
    wait_until(lambda: said in run.stderr, said)
    lines = len(run.stderr.splitlines())
    wait_until(lambda: len(run.stderr.splitlines()) > lines, 'progress')
    run.process.send_signal(signal.SIGINT)
    assert run.wait() == 0, run.stderr
    assert (run.stderr.count(said), run.survivors()) == (1, {})
