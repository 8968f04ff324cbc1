"""Mathematics of the package, without ROS: what a script needs stands here, the rest may move.

    from backlash_ros.core import Parameters, build_closed_loop

    run = build_closed_loop(Parameters({'output_noise_std': 1e-3})).run(600)
    print(run.column('c_r')[-1])
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from backlash_ros.core.assembly import build_controller, build_plant, build_reference
    from backlash_ros.core.estimate import Estimate, Status
    from backlash_ros.core.parameters import Parameters
    from backlash_ros.core.record_fit import fit_record
    from backlash_ros.core.simulation.closed_loop import build_closed_loop

__all__ = [
    'Estimate', 'Parameters', 'Status', 'build_closed_loop', 'build_controller', 'build_plant',
    'build_reference', 'fit_record',
]

_HOMES = dict(zip(__all__, (
    'estimate', 'parameters', 'estimate', 'simulation.closed_loop', 'assembly', 'assembly',
    'assembly', 'record_fit',
), strict=True))


def __getattr__(name: str) -> Any:
    # Imported when asked for: a node that only needs the parameters does not wait for scipy.
    if name not in _HOMES:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    return getattr(import_module(f'{__name__}.{_HOMES[name]}'), name)
