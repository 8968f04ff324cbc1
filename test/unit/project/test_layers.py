"""Layers: core <- bags <- nodes, bags <- tools; ROS in nodes only; the rooms of the core."""

import ast
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from places import ROOT

PACKAGE = 'backlash_ros'
SHARED = {
    PACKAGE,
    *(f'{PACKAGE}.{name}' for name in ('atomic_file', 'middleware', 'options', 'topics')),
}
LAYERS = ('core', 'bags', 'nodes', 'tools')
# Each room of the core imports from those before it only; likewise the parts of estimation.
ROOMS = (
    'priority', 'jobs', 'parameters', 'plant', 'window', 'estimate', 'law', 'laws', 'estimation',
    'control', 'scenario', 'assembly', 'loop', 'records', 'simulation', 'record_fit',
    'judgement', 'identification', 'driver_check',
)
ESTIMATION = (
    'settings', 'plant_family', 'posterior', 'fit', 'unmodelled', 'search', 'explanations',
    'late_commands', 'belief', 'state_machine', 'observer', 'estimator',
)
NUMERIC = {'numpy', 'scipy'}
ROS_SUFFIXES = ('_msgs', '_srvs', '_interfaces')
ROS_PREFIXES = ('rclpy', 'rosidl', 'launch')
SOURCES = sorted((ROOT / PACKAGE).rglob('*.py'))


def imported_modules(source: str, module: str, is_package: bool) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ''
            if node.level:
                parts = module.split('.')
                parts = parts[: len(parts) - node.level + is_package]
                base = '.'.join([*parts, base] if base else parts)
            # `from backlash_ros import nodes` imports a module too.
            yield from (
                [f'{base}.{alias.name}' for alias in node.names]
                if base in (PACKAGE, *(f'{PACKAGE}.{layer}' for layer in LAYERS))
                else [base])


def is_ros(module: str) -> bool:
    top = module.split('.')[0]
    return top.startswith(ROS_PREFIXES) or top.endswith(ROS_SUFFIXES)


def within(module: str, layer: str) -> bool:
    return module == f'{PACKAGE}.{layer}' or module.startswith(f'{PACKAGE}.{layer}.')


def is_upwards(module: str, imported: str, folder: str, order: tuple[str, ...]) -> bool:
    parts = [name.removeprefix(f'{folder}.').split('.')[0] for name in (module, imported)]
    if not (module.startswith(f'{folder}.') and imported.startswith(f'{folder}.')):
        return False
    return order.index(parts[1]) > order.index(parts[0])


def is_allowed(module: str, imported: str) -> bool:
    top = imported.split('.')[0]
    if within(module, 'core'):
        known = top in sys.stdlib_module_names | NUMERIC or within(imported, 'core')
        return known or imported == f'{PACKAGE}.atomic_file'
    if within(module, 'bags'):
        return (
            top in sys.stdlib_module_names | {'mcap', 'rosbags'} or imported in SHARED
            or within(imported, 'core') or within(imported, 'bags'))
    if within(module, 'nodes'):
        return not within(imported, 'tools')
    if within(module, 'tools'):
        return not is_ros(imported) and not within(imported, 'nodes')
    return top in sys.stdlib_module_names or imported in SHARED


def names_of(path: Path) -> tuple[str, bool]:
    """Name of the module at a path, and whether it is a package."""
    parts = path.relative_to(ROOT).with_suffix('').parts
    is_package = parts[-1] == '__init__'
    return '.'.join(parts[:-1] if is_package else parts), is_package


def test_module_imports_only_what_its_layer_may() -> None:
    found = {}
    for path in SOURCES:
        module, is_package = names_of(path)
        imported = imported_modules(path.read_text(), module, is_package)
        found[module] = [name for name in imported if not is_allowed(module, name)]
    assert {module: names for module, names in found.items() if names} == {}
    assert {module.split('.')[1] for module in found if '.' in module} >= {*LAYERS, 'topics'}


@pytest.mark.parametrize(
    ('folder', 'order'), [(f'{PACKAGE}.core', ROOMS), (f'{PACKAGE}.core.estimation', ESTIMATION)],
)
def test_rooms_of_the_core_are_stacked(folder: str, order: tuple[str, ...]) -> None:
    upwards, seen = [], set()
    for path in SOURCES:
        module, is_package = names_of(path)
        for imported in imported_modules(path.read_text(), module, is_package):
            if module.startswith(f'{folder}.') and imported.startswith(f'{folder}.'):
                seen.update(
                    name.removeprefix(f'{folder}.').split('.')[0] for name in (module, imported))
                if is_upwards(module, imported, folder, order):
                    upwards.append(f'{module} imports {imported}')
    assert upwards == []
    assert seen >= set(order) - {'parameters', 'estimate', 'worker'}


def test_no_two_files_need_each_other_and_none_takes_private_names() -> None:
    imports: dict[str, set[str]] = {}
    private = []
    for path in SOURCES:
        module, is_package = names_of(path)
        source = path.read_text()
        imports[module] = set(imported_modules(source, module, is_package))
        private += [
            f'{module}: {alias.name}'
            for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ImportFrom)
            for alias in node.names
            if (node.module or '').startswith(PACKAGE) and alias.name.startswith('_')]
    assert private == []
    order = TopologicalSorter(imports).static_order()
    assert len(list(order)) >= len(SOURCES)  # raises CycleError, which names the files
