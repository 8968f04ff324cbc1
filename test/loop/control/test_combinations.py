"""Every law in every structure, whatever is not as it should be: bounded, and no false claim."""

import re
from functools import cache
from math import inf, isfinite

import pytest
from combinations_of_laws import AMPLITUDES, CONDITIONS, Sample, outcome, run
from places import ROOT

from backlash_ros.core.assembly import LAWS, STRUCTURES, build_controller, law_fits
from backlash_ros.core.control.structure import LARGEST_F_OVER_M, LARGEST_FEEDBACK
from backlash_ros.core.estimate import was_given
from backlash_ros.core.parameters import ParameterError, Parameters

DOCS = ROOT / 'docs'
PAIRS = [(law, structure) for structure in STRUCTURES for law in LAWS]
FIT = [pair for pair in PAIRS if law_fits(*pair)]
LARGEST_F, LARGEST_CROSSING = 0.5, 100.0  # the default bounds
# What the table of docs/faults.md promises of the default law.
LEARNS = {
    name for name in CONDITIONS
    if name not in ('y_m at rest', 'y_m comes to rest', 'driver limits v in silence')
}
Loop = tuple[str, str, str]


@cache
def samples_of(law: str, structure: str, condition: str) -> list[Sample]:
    return run(law, structure, CONDITIONS[condition])


@cache
def asked_by_the_reference(structure: str, condition: str) -> float:
    changes = {
        **CONDITIONS[condition].changes, 'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9,
        'estimator.initial.m': 1.3, 'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
        'control.min': -inf, 'control.max': inf, 'control.rate_max': inf, 'output_noise_std': 0.0}
    without = CONDITIONS[condition]._replace(changes=changes, driver_limit=inf)
    return max(abs(sample.u_d) for sample in run('fixed', structure, without))


@pytest.fixture(params=[(*pair, name) for pair in FIT for name in CONDITIONS], ids='-'.join)
def loop(request: pytest.FixtureRequest) -> Loop:
    found: Loop = request.param
    return found


def test_every_command_is_bounded(loop: Loop) -> None:
    _, structure, name = loop
    samples = samples_of(*loop)
    changes = CONDITIONS[name].changes
    move = float(str(changes.get('control.rate_max', inf))) * 0.01
    high = float(str(changes.get('control.max', inf)))
    if structure == 'proportional':
        # u_d = m/(m - f) (y_m + f c)
        allowed = (AMPLITUDES[structure] + LARGEST_F * LARGEST_CROSSING) / (1.0 - LARGEST_F_OVER_M)
        reach = allowed
    else:
        allowed, reach = 1.05 * (1.0 + LARGEST_FEEDBACK), asked_by_the_reference(structure, name)
    v_before = 0.0
    for sample in samples:
        e = sample.estimate
        if structure != 'proportional':
            reach = max(reach, e.m * (e.c_r - e.c_l))
            assert abs(sample.u_d) <= allowed * reach
        else:
            assert abs(sample.u_d) <= allowed
        assert isfinite(sample.v)
        assert abs(sample.v) <= high
        assert abs(sample.v - v_before) <= move * (1.0 + 1e-9)
        v_before = sample.v


def test_who_says_that_it_has_learned_is_right(loop: Loop) -> None:
    for sample in samples_of(*loop):
        if sample.claims and not was_given(sample.estimate):
            assert sample.is_right, sample


@pytest.mark.parametrize('name', sorted(LEARNS))
@pytest.mark.parametrize('structure', STRUCTURES)
def test_the_default_law_learns_whatever_the_structure(structure: str, name: str) -> None:
    assert outcome(samples_of('moving_horizon', structure, name)) == 'learned'


@pytest.mark.parametrize(('law', 'structure'), [pair for pair in PAIRS if pair not in FIT])
def test_what_cannot_work_is_refused_when_it_is_configured(law: str, structure: str) -> None:
    with pytest.raises(ParameterError, match=f'structure=.*{structure}.*must be .* for .*{law}'):
        build_controller(Parameters({'estimator.law': law, 'structure': structure}))


def test_the_document_says_what_comes_out() -> None:
    page = (DOCS / 'faults.md').read_text()
    for law, structure in FIT:
        row = re.search(rf'^\| `{law}`, `{structure}` \|(.*)\|$', page, re.MULTILINE)
        cells = [cell.strip() for cell in row[1].split('|')]
        assert cells == [outcome(samples_of(law, structure, name)) for name in CONDITIONS]
