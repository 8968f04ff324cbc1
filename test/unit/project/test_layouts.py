"""The shipped layouts of PlotJuggler and Foxglove hang together."""

from collections.abc import Iterator

import pytest
from shown_layouts import (
    FOXGLOVE,
    FOXGLOVE_PATH,
    PANELS,
    PLOTJUGGLER,
    PLOTJUGGLER_PATH,
    curves,
    foxglove_paths,
    parts,
)

from backlash_ros import topics


def panels_in(tree: object) -> Iterator[str]:
    """The panels of a tree of splits."""
    if isinstance(tree, dict):
        yield from panels_in(tree['first'])
        yield from panels_in(tree['second'])
    else:
        yield str(tree)


@pytest.mark.parametrize('paths', [
    {parts(PLOTJUGGLER_PATH, path) for path in curves()},
    {parts(FOXGLOVE_PATH, path) for path in foxglove_paths()},
], ids=['plotjuggler', 'foxglove'])
def test_a_layout_shows_estimates_with_bands_signals_loop_status_and_latency(paths):
    labels = {'y_m', 'y', 'u_d', 'v', 'status', 'latency_s', 'innovation', 'gap'}
    labels |= {f'{name}{end}' for name in ('m', 'c_r', 'c_l') for end in ('', '_low', '_high')}
    of_the_loop = {topics.SIGNAL_LABELS.index('v'), topics.SIGNAL_LABELS.index('u_hat')}
    assert paths == {
        *((f'/{topics.watched(label)}', 'data', -1) for label in labels),
        *((f'/{topics.SIGNALS}', 'data', index) for index in of_the_loop),
    }


def test_abscissa_and_ordinate_of_the_loop_are_v_and_u_of_one_message() -> None:
    v, u = (f'data[{topics.SIGNAL_LABELS.index(label)}]' for label in ('v', 'u_hat'))
    drawn = [curve for curve in PLOTJUGGLER.iter('curve') if 'curve_x' in curve.attrib]
    assert [(c.attrib['curve_x'], c.attrib['curve_y']) for c in drawn] == [
        (f'/{topics.SIGNALS}/{v}', f'/{topics.SIGNALS}/{u}')
    ]
    panel = PANELS['Plot!loop']
    assert panel['xAxisVal'] == 'custom'
    assert panel['xAxisPath']['value'] == f'/{topics.SIGNALS}.{v}'
    assert [path['value'] for path in panel['paths']] == [f'/{topics.SIGNALS}.{u}']


def test_every_panel_of_foxglove_has_its_place() -> None:
    assert sorted(panels_in(FOXGLOVE['layout'])) == sorted(PANELS)
