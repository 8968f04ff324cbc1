"""Files that version 0.2.0 has written: half a second of the paper's example, in lockstep."""

from pathlib import Path

import numpy as np
import pytest
from places import ROOT

from backlash_ros.core.assembly import build_controller
from backlash_ros.core.estimates_file import load_estimate
from backlash_ros.tools.config import effective_parameters
from backlash_ros.tools.replay import main as replay
from backlash_ros.tools.runs.read_run import read_run

OLD = ROOT / 'test' / 'of_0_2_0'
LAST = {'m': 1.30029, 'c_r': 3.00258, 'c_l': -2.99812}  # as 0.2.0 printed them


def test_parameter_file_means_what_it_meant() -> None:
    parameters = effective_parameters(OLD / 'parameters.yaml')
    assert (parameters.lockstep, parameters.samples, parameters.output_noise_std) == (
        True, 50, 1e-4,
    )
    assert parameters.estimator.law == 'moving_horizon'
    build_controller(parameters)


def test_saved_estimates_are_begun_with() -> None:
    parameters = effective_parameters(OLD / 'parameters.yaml', [
        'estimates.load=true', f'estimates.file={OLD / "estimates.json"}',
    ])
    found = load_estimate(parameters)
    assert found is not None
    assert {name: getattr(found, name) for name in LAST} == pytest.approx(LAST, rel=1e-5)
    assert found.learned
    assert build_controller(parameters).step(0.0, 0.0).estimate.m == pytest.approx(found.m)


@pytest.mark.parametrize('name', ['bag', 'record.npz', 'samples.csv'])
def test_run_is_read_from_each_of_its_files(name: str) -> None:
    run = read_run(OLD / name)
    assert run.parameters is not None
    assert (run.record.samples, run.record.lost_samples) == (50, 0)
    assert {of: run.record.column(of)[-1] for of in LAST} == pytest.approx(LAST, rel=1e-5)
    columns = [run.record.column(column) for column in ('t', 'y_m', 'y', 'v')]
    others = [read_run(OLD / 'bag').record.column(column) for column in ('t', 'y_m', 'y', 'v')]
    np.testing.assert_allclose(columns, others, rtol=1e-12)


@pytest.mark.usefixtures('undrawn')
def test_bag_is_replayed(tmp_path: Path) -> None:
    assert replay([str(OLD / 'bag'), '--out', str(tmp_path)]) == 0
    assert read_run(tmp_path).record.samples == 50
