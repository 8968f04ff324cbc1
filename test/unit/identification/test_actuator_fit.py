"""Command and motor encoder of one record tell the position loop between them."""

from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from backlash_ros.core import Parameters, build_plant
from backlash_ros.core.control.motion import strokes
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import Identification, identify
from backlash_ros.core.identification.structure_search import Options
from backlash_ros.core.records.record import Record
from backlash_ros.tools.identify.outcome import commented_yaml, identified_parameters, write_record
from backlash_ros.tools.records.messages import from_messages
from backlash_ros.tools.records.reading import read_record

PERIOD = 0.005
TRUE = Parameters({
    'sample_period': PERIOD, 'plant.numerator': (0.3, 0.2), 'plant.denominator': (1.0, -0.6, 0.1),
    'actuator.numerator': (0.03, 0.02), 'actuator.denominator': (1.0, -1.6, 0.65),
    'actuator.wind_up': (0.05, 0.03), 'output_noise_std': 1e-4,
    'backlash.m': 1.0, 'backlash.c_r': 0.15, 'backlash.c_l': -0.1})
NOISE, SAMPLES = 1e-4, 2400


@lru_cache
def record() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    plant, rng, rows = build_plant(TRUE), np.random.default_rng(2), []
    for command in islice(strokes(-1.0, 1.0, 4.0, PERIOD, SAMPLES * PERIOD, 0.0), SAMPLES):
        y = plant.measure()
        plant.step(command)
        rows.append((command, plant.applied + NOISE * float(rng.standard_normal()), y))
    commands, motor, y = np.array(rows).T
    return commands, motor, y


@lru_cache
def found() -> Identification:
    _, motor, y = record()
    return identify(motor, y, PERIOD, Options(orders=(1, 2), delays=(0,), integrators=(False,)))


def test_lag_and_wind_up_are_found() -> None:
    actuator = with_actuator(found(), record()[0]).actuator
    assert actuator.wind_up == pytest.approx((0.05, 0.03), rel=0.02)
    w = np.exp(1j * np.geomspace(0.01, 0.3, 20))
    true = np.polyval((0.03, 0.02), w) / np.polyval((1.0, -1.6, 0.65), w)
    assert np.abs(actuator.lag.response(w) / true - 1.0).max() < 0.01


def test_nothing_lies_between_a_command_and_a_report_that_repeats_it() -> None:
    found_so = with_actuator(found(), record()[1])
    assert found_so.actuator is None
    assert not found_so.remarks


def test_a_motor_that_no_lag_describes_is_told_of_and_left_out() -> None:
    commands, motor, _ = record()
    # The same record, as if the motor had followed only half as far on the way up.
    bent = np.where(commands > 0.0, 2.0 * commands, commands)
    found_so = with_actuator(found(), bent)
    assert found_so.actuator is None
    assert 'applied_control differs from control by' in found_so.remarks[-1]
    assert len(motor) == len(bent)


def test_the_file_holds_it_and_forgets_one_that_is_not_there() -> None:
    found_so = with_actuator(found(), record()[0])
    given = {'control.min': -1.0, 'control.max': 1.0, 'control.rate_max': 4.0}
    parameters = identified_parameters(found_so, given)
    assert parameters['actuator.wind_up'] == pytest.approx((0.05, 0.03), rel=0.02)
    assert parameters['estimator.use_applied_control'] == 'true'
    # Every digit: twelve would split a double integrator into a stable and an unstable pole.
    assert parameters['plant.denominator'] == found_so.model.denominator
    assert 'actuator' in commented_yaml(parameters, found_so, 'a test')
    again = identified_parameters(replace(found_so, actuator=None), {
        **given, 'actuator.numerator': (1.0,), 'actuator.denominator': (1.0, 0.0)})
    assert again['actuator.numerator'] == ()


def test_a_csv_keeps_the_commands_beside_v(tmp_path: Path) -> None:
    commands, motor, y = record()
    path = tmp_path / 'record.csv'
    write_record(Record(motor, y, PERIOD, commands=commands), path)
    read = read_record(path)
    np.testing.assert_allclose(read.commands, commands)
    np.testing.assert_allclose(read.v, motor)
    write_record(Record(motor, y, PERIOD), path)
    assert read_record(path).commands is None


def test_messages_tell_commands_and_reports_of_each_interval() -> None:
    stamps = 10**18 + np.arange(50) * 5_000_000
    reports = [(stamp - 100_000, k) for k, stamp in enumerate(stamps)]
    # The first command comes after five reports: until then the motor rests where it is.
    control = [(stamp + 300_000, 100.0 + k) for k, stamp in enumerate(stamps)][5:]
    read = from_messages({
        'plant_output': [(stamp, 0.0) for stamp in stamps], 'applied_control': reports,
        'control': control}, PERIOD)
    assert read.v[:8].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
    assert read.commands[:8].tolist() == [1.0, 1.0, 1.0, 1.0, 1.0, 105.0, 106.0, 107.0]
