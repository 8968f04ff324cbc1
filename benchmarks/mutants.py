"""How many small faults, put into the package by a seed, the tests find.

    .venv/bin/python benchmarks/mutants.py --seed 1 --count 80 [--rooms unit loop system]
A mutant has one operator, comparison, constant or call changed. It meets the 12 nearest test files
of those whose imports lead to its module, until one of them fails; - says that none has.
"""

import argparse
import ast
import random
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from reporting import ROOT

PAIRS = [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot),
         (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or)]
SWAPS = dict([*PAIRS, *((b, a) for a, b in PAIRS)])
HOMES = {ROOT: 'backlash_ros/', ROOT / 'test': '', ROOT / 'benchmarks': ''}  # of modules
LEFT_OUT = shutil.ignore_patterns('.git', '.venv', 'results', 'build', '__pycache__', '.*_cache')


def mutations(tree: ast.Module) -> list[tuple[ast.AST, str, object]]:
    """All that may be changed: a node, its field, the other value."""
    found: list[tuple[ast.AST, str, object]] = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.BinOp, ast.BoolOp)) and type(node.op) in SWAPS:
            found.append((node, 'op', SWAPS[type(node.op)]()))
        elif isinstance(node, ast.Compare) and (other := SWAPS.get(type(node.ops[0]))):
            found.append((node, 'ops', [other(), *node.ops[1:]]))
        elif isinstance(node, ast.Constant) and isinstance(value := node.value, (int, float)):
            other = not value if isinstance(value, bool) else type(value)(1.3 * value + 1)
            found.append((node, 'value', other))
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            found.append((node, 'value', ast.Constant(None)))
    return found


def tests_of(module: str, rooms: list[str]) -> list[str]:
    """Test files whose imports lead to a module, the nearest first."""
    files = {'.'.join(path.relative_to(base).with_suffix('').parts).removesuffix('.__init__'): path
             for base, inside in HOMES.items() for path in base.glob(f'{inside}**/*.py')}
    needs = {name: {part for node in ast.walk(ast.parse(path.read_text()))
                    if isinstance(node, ast.ImportFrom) and node.module
                    for part in (node.module, *(f'{node.module}.{a.name}' for a in node.names))}
             for name, path in files.items()}
    near = [module]
    for name in near:
        near += [other for other in files if other not in near and name in needs[other]]
    found = [files[name].relative_to(ROOT).parts for name in near if '.test_' in name]
    return ['/'.join(p) for p in found if p[1] in rooms and 'project' not in p][:12]


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (('--seed', 1), ('--count', 80)):
        parser.add_argument(name, type=int, default=default)
    parser.add_argument('--rooms', nargs='+', default=['unit', 'loop'])
    options, caught = parser.parse_args(), 0
    places = [(path, i) for path in sorted(ROOT.glob('backlash_ros/**/*.py'))
              for i in range(len(mutations(ast.parse(path.read_text()))))]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(ROOT, f'{folder}/copy', ignore=LEFT_OUT))
        for path, i in random.Random(options.seed).sample(places, options.count):
            node, field, value = mutations(tree := ast.parse(path.read_text()))[i]
            before, where = ast.unparse(node), path.relative_to(ROOT)
            setattr(node, field, value)
            (copy / where).write_text(ast.unparse(tree))
            tests = tests_of(str(where)[:-3].replace('/', '.'), options.rooms)
            pytest = [sys.executable, '-m', 'pytest', '-xqq', '-p', 'no:cacheprovider', *tests]
            out = tests and subprocess.run(pytest, cwd=copy, capture_output=True, text=True).stdout
            by = re.findall('^(?:FAILED|ERROR) .{,140}', out or '', re.MULTILINE)
            caught += bool(by)
            shutil.copy(path, copy / where)
            print(f'{where}:{node.lineno}: {before} ->', ast.unparse(node), by or '-', flush=True)
    print(caught, 'of', options.count, 'caught')
