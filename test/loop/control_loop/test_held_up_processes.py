"""The example driver is learned from while both processes are held up, in simulated time."""

from __future__ import annotations

from pathlib import Path

import pytest
from cases.held_up import HeldUpProcesses
from simulated_motor import C_L, C_R

from backlash_ros.core.estimate import Status
from backlash_ros.tools.config import effective_parameters

CONFIG = Path('geared_motor.yaml')
SECONDS, LEARNED_S = 4.0, 3.0


@pytest.mark.parametrize('use', ['false', 'auto'])
@pytest.mark.parametrize('seed', [3, 11])
def test_late_commands_and_outputs_do_not_keep_it_from_learning(seed: int, use: str) -> None:
    p = effective_parameters(CONFIG, [f'estimator.use_applied_control={use}'])
    processes = HeldUpProcesses(p, 1.0, seed, reports=use == 'auto')
    heard = processes.run(SECONDS)
    loop, law = processes.loop, processes.loop.core.estimator
    assert loop.statistics.lost > 20
    assert loop.commands.late > 50
    if use == 'false':
        assert law.report.reattributed > 5
    for time_s, e in heard:
        if time_s > LEARNED_S:
            assert abs(e.c_r - C_R) < 0.02 * C_R
            assert abs(e.c_l - C_L) < 0.02 * -C_L
    assert heard[-1].estimate.status is not Status.ACQUIRING
