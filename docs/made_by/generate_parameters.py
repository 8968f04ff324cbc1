"""Writes docs/reference/parameters.md from the one table of parameters; `make docs` calls it."""

from pathlib import Path

from backlash_ros.core.parameters.parameter import Parameter, as_yaml
from backlash_ros.core.parameters.table import BY_NAME

PAGE = Path(__file__).resolve().parents[1] / 'reference' / 'parameters.md'
HEAD = """# Parameters

Made from [table.py](../../backlash_ros/core/parameters/table.py) by `make docs`; do not edit.
The nodes, `bringup` and `simulate` all read one YAML file:
[paper_example.yaml](../../config/paper_example.yaml) shows every group.
`y`, `y_m`, `u` and `v` stand for the units of those signals. Parameters marked *live* may change in
a running node; all others of `controller`, but for those marked *fixed*, while it is unconfigured.

| name | default | unit | allowed | meaning | used by |
|---|---|---|---|---|---|
"""


def parameters_page() -> str:
    return HEAD + ''.join(f'{_row(parameter)}\n' for parameter in BY_NAME.values())


def _row(p: Parameter) -> str:
    users = ', '.join([*p.used_by, *{'live': ['*live*'], 'never': ['*fixed*']}.get(p.change, [])])
    cells = (f'`{p.name}`', f'`{as_yaml(p.default)}`', p.unit, _allowed(p), p.description, users)
    return '| ' + ' | '.join(cell.replace('|', '\\|') for cell in cells) + ' |'


def _allowed(p: Parameter) -> str:
    if p.choices:
        return ', '.join(f'`{choice}`' for choice in p.choices)
    if isinstance(p.default, bool):
        return '`true`, `false`'
    return ', '.join(filter(None, (p.rules, f'{p.length} numbers' if p.length else '')))


def write_parameters() -> None:
    PAGE.write_text(parameters_page(), encoding='utf-8')


if __name__ == '__main__':
    write_parameters()
