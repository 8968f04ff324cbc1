"""The loop at 1 kHz: nothing lost on its way, and a controller that does not grow."""

from __future__ import annotations

import re
import time

from reporting import Check

from real_time.costs import resident_mb
from real_time.node_processes import node_command, processes, wait_for_event

PERIOD_S = 1e-3
GROWTH_LIMIT_MB = 1.0
WARM_UP = 0.5  # share of the time before memory is looked at: records and histories fill up once
# G(z) of the paper's example at a period of 1 ms.
PLANT = {
    'plant.numerator': [1.994012e-7, 7.952171e-7, 1.982084e-7],
    'plant.denominator': [1.0, -2.98805183, 2.97612354, -0.98807171],
    'sample_period': PERIOD_S,
}


def soak_checks(seconds: float) -> list[Check]:
    """Plant, reference and controller for so long."""
    samples = round(seconds / PERIOD_S)
    waiting = {'wait_for_subscribers': 1}
    commands = {
        'controller': node_command(
            'controller', {**PLANT, **waiting, 'estimator.output_noise_std': 1e-3}),
        'reference': node_command('reference', {'sample_period': PERIOD_S, **waiting}),
        'plant': node_command(
            'plant', {**PLANT, **waiting, 'samples': samples, 'output_noise_std': 1e-3}),
    }
    with processes(commands) as (supervisor, _):
        wait_for_event(supervisor, lambda kind, who: (kind, who) == ('ready', 'plant'))
        time.sleep(WARM_UP * seconds)
        controller = next(c for c in supervisor.children if c.name == 'controller')
        before = resident_mb(controller.process.pid)
        time.sleep((1.0 - WARM_UP) * seconds - 1.0)
        growth = resident_mb(controller.process.pid) - before
        wait_for_event(supervisor, lambda kind, _: kind == 'done', 2.0 * seconds)
        supervisor.stop()
        said = controller.log.read_text().strip().splitlines()[-1]
    counts = dict(re.findall(r'([a-z][a-z ]*): (\d+)', said))
    lost, unsent = (int(counts.get(name, 0)) for name in ('lost', 'of these never sent'))
    return [
        Check(f'1 kHz: samples lost between plant and controller, of {counts["samples"]}', '0',
              str(lost - unsent), lost == unsent),
        Check('1 kHz: samples for which the machine let the plant wake too late', '0',
              str(unsent), not unsent),
        Check(f'memory of the controller after {(1.0 - WARM_UP) * seconds:g} s [MB]',
              f'< {GROWTH_LIMIT_MB:g}', f'{growth:+.3f}', growth < GROWTH_LIMIT_MB),
    ]
