"""Which way messages go between nodes of one machine."""

from pathlib import Path

import pytest

from backlash_ros.middleware.loopback import (
    NETWORK_PROFILE,
    OF_THE_FOLDER,
    PROFILE,
    VARIABLE,
    prefer_loopback,
)

HERE = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def chosen(environment: dict[str, str]) -> str | None:
    prefer_loopback(environment)
    return environment.get(VARIABLE)


def test_profile_is_taken_where_nobody_else_is_to_be_met() -> None:
    assert chosen({**HERE}) == str(PROFILE)
    assert PROFILE.is_file()


def test_named_machines_are_reached_with_the_profile_of_the_network() -> None:
    assert chosen({**HERE, 'ROS_STATIC_PEERS': '192.168.0.2'}) == str(NETWORK_PROFILE)
    assert NETWORK_PROFILE.is_file()


@pytest.mark.parametrize('environment', [{}, {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}])
def test_other_machines_stay_within_reach(environment: dict[str, str]) -> None:
    assert chosen(environment) is None


def test_a_profile_of_the_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen({**HERE, VARIABLE: 'own.xml'}) == 'own.xml'
    monkeypatch.chdir(tmp_path)
    (tmp_path / OF_THE_FOLDER).touch()
    assert chosen({**HERE}) is None
