"""What a script without ROS may import from the core."""

import inspect

import pytest

import backlash_ros.core as core


@pytest.mark.parametrize('name', core.__all__)
def test_every_public_name_is_there(name: str) -> None:
    found = getattr(core, name)
    assert found.__module__.startswith('backlash_ros.core.')
    # That of a class without one would be its parent's.
    assert vars(found).get('__doc__') or (inspect.isfunction(found) and found.__doc__)


def test_example_of_the_package_runs(capsys: pytest.CaptureFixture[str]) -> None:
    assert core.__doc__ is not None
    code = '\n'.join(line.strip() for line in core.__doc__.splitlines()[2:])
    exec(code, {})
    assert 2.0 < float(capsys.readouterr().out) < 4.0
