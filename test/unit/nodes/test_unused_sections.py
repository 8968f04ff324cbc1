"""Sections of a parameter file that do not reach the node they are meant for."""

import pytest

from backlash_ros.nodes.runtime.parameters import unused


@pytest.mark.parametrize(('sections', 'full_name'), [
    (['/**', '/plant'], '/arm/plant'), (['/arm/plant'], '/plant'), (['/plant'], '/left_plant'),
    (['/plnt'], '/plant'),
])
def test_section_that_does_not_reach_its_node_is_named(sections, full_name):
    assert list(unused(sections, 'plant', full_name)) == [sections[-1]]


@pytest.mark.parametrize(('sections', 'full_name'), [
    (['/**', '/plant'], '/plant'), (['/**/plant'], '/plant'), (['/**/plant'], '/a/b/plant'),
    (['/*/plant'], '/a/plant'), (['/pan/plant', '/tilt/plant'], '/pan/plant'),
    (['/**', '/tilt/plant'], '/pan/plant'), (['/**', '/controller', '/somebody_else'], '/plant'),
    (['/tilt/**'], '/pan/plant'),
])
def test_other_sections_are_no_concern(sections: list[str], full_name: str) -> None:
    assert list(unused(sections, 'plant', full_name)) == []
