"""The simulated runs that the documents show."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from backlash_ros.core.assembly import build_model
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.simulation.closed_loop import build_closed_loop
from backlash_ros.core.simulation.run_record import RunRecord
from backlash_ros.tools.config import effective_parameters
from backlash_ros.tools.runs.read_run import run_loop

# No compensation: the inverse is told that there is no gap, and learns nothing.
WITHOUT = {'estimator.law': 'fixed', 'estimator.initial.c_r': '0.0', 'estimator.initial.c_l': '0.0'}


@dataclass(frozen=True)
class Run:
    """One run: what `simulate --config CONFIG --set ... --duration SECONDS` computes."""

    parameters: Parameters
    record: RunRecord
    delay: int  # samples by which y is meant to follow y_m
    model: TransferFunction  # G at the end: the learned one where one is in use


def simulate(
    duration: float, settings: Mapping[str, str] | None = None, config: str | None = None,
) -> Run:
    """Run once, or take the run that has been made already."""
    return _simulate(duration, tuple((settings or {}).items()), config)


@cache
def _simulate(duration: float, settings: tuple[tuple[str, str], ...], config: str | None) -> Run:
    parameters = effective_parameters(
        Path(config) if config else None, [f'{name}={value}' for name, value in settings])
    loop = build_closed_loop(parameters)
    record = run_loop(loop, round(duration / parameters.sample_period))
    learned = loop.controller.redesign.adopted
    model = build_model(parameters) if learned is None else learned.transfer_function
    return Run(parameters, record, loop.controller.structure.delay, model)
