"""Which way messages go between nodes of one machine."""

from pathlib import Path

import pytest

from backlash_ros.middleware.loopback import PROFILE, prefer_loopback

HERE = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}


def chosen(environment: dict[str, str]) -> str | None:
    prefer_loopback(environment)
    return environment.get('FASTRTPS_DEFAULT_PROFILES_FILE')


@pytest.mark.parametrize(('environment', 'profile'), [
    (HERE, PROFILE), ({**HERE, 'ROS_STATIC_PEERS': '192.168.0.2'}, PROFILE.with_stem('network')),
    ({}, None), ({'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}, None),
])
def test_a_profile_follows_from_who_is_to_be_met(environment, profile) -> None:
    assert chosen({**environment}) == (profile and str(profile))
    assert profile is None or profile.is_file()


def test_a_profile_of_the_user_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen({**HERE, 'FASTRTPS_DEFAULT_PROFILES_FILE': 'own.xml'}) == 'own.xml'
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').touch()
    assert chosen({**HERE}) is None
