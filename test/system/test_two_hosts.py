"""The loop between two hosts, which are network namespaces of this machine."""

from __future__ import annotations

from pathlib import Path

import pytest
from hosts.linked_hosts import Cable, linked_hosts, why_not
from two_hosts import Case, run


@pytest.fixture(scope='module', autouse=True)
def _needs_namespaces() -> None:
    if reason := why_not():
        pytest.skip(reason)


def test_backlash_is_learned_from_a_driver_on_another_host(tmp_path: Path) -> None:
    row = run(Case('veth pair'), 5.0, tmp_path)
    assert row.learned_s < 5.0
    assert row.lost < 0.01 * row.samples


def test_what_a_cable_loses_is_repeated_before_it_matters(tmp_path: Path) -> None:
    row = run(Case('cable', cable=Cable(loss_percent=5.0)), 3.0, tmp_path)
    assert row.lost < 0.01 * row.samples
    assert row.late < 0.1 * row.samples


def test_hosts_are_gone_afterwards() -> None:
    with linked_hosts() as hosts:
        names = {host.namespace for host in hosts}
        assert names <= {path.name for path in Path('/run/netns').iterdir()}
    assert not names & {path.name for path in Path('/run/netns').iterdir()}
