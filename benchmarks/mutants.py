"""How many small faults, put into the package by a seed, the tests find.

    .venv/bin/python benchmarks/mutants.py --seed 1 --count 80 [test/unit test/loop]
A mutant has one operator, comparison, constant or call changed. All stand in one copy, each behind
a switch. The tests run once with all switches off and note which of them come past which. A mutant
meets these and the rest of their files, or any if it acts on import, the quickest first and for a
minute at most, until one fails.
"""

import argparse
import ast
import os
import random
import re
import subprocess
import sys
from copy import copy
from itertools import accumulate
from pathlib import Path
from shutil import copytree, ignore_patterns
from tempfile import TemporaryDirectory

PAIRS = [(ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot),
         (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.And, ast.Or)]
SWAPS = dict([*PAIRS, *((b, a) for a, b in PAIRS)])
LEFT_OUT = ignore_patterns('.git', '.venv', 'results', 'build', '__pycache__', '.*_cache')
SWITCH = """
import builtins, os
def _on(number, noted=set()):
    note = f"{number} {os.environ.get('PYTEST_CURRENT_TEST', '').rpartition(' (')[0]}"
    if note not in noted and not noted.add(note):
        print(note, file=open(os.environ.get('NOTES', os.devnull), 'a'), flush=True)
    return str(number) == os.environ.get('MUTANT')
builtins._on = _on"""


def changed(node: ast.AST) -> tuple[ast.AST, ast.AST] | None:
    """The expression that may be changed here, and into what."""
    other = copy(node)
    if isinstance(other, (ast.BinOp, ast.BoolOp)) and type(other.op) in SWAPS:
        other.op = SWAPS[type(other.op)]()
    elif isinstance(other, ast.Compare) and type(other.ops[0]) in SWAPS:
        other.ops = [SWAPS[type(other.ops[0])](), *other.ops[1:]]
    elif isinstance(other, ast.Constant) and isinstance(value := other.value, (int, float)):
        other.value = not value if isinstance(value, bool) else type(value)(1.3 * value + 1)
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        return node.value, ast.Constant(None)
    return (node, other) if vars(other) != vars(node) else None


def pytest(*options: str, **variables: str) -> str:
    command = [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', '--timeout=300', *options]
    return subprocess.run(command, env={**os.environ, **variables}, stdout=-1, text=True).stdout


parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument('--seed', type=int, default=1)
parser.add_argument('--count', type=int, default=80)
parser.add_argument('tests', nargs='*', default=['test/unit', 'test/loop'])
options, caught, says = parser.parse_args(), 0, []
with TemporaryDirectory() as folder:
    os.chdir(copytree(Path(__file__).resolve().parents[1], f'{folder}/copy', ignore=LEFT_OUT))
    os.environ['PYTHONPATH'] = f'{folder}/copy'
    trees = {p: ast.parse(p.read_text()) for p in sorted(Path('backlash_ros').rglob('*.py'))}
    places = [(path, *pair) for path, tree in trees.items() for node in ast.walk(tree)
              if (pair := changed(node))]
    for path, node, on in random.Random(options.seed).sample(places, options.count):
        says.append(f'{path}:{node.lineno}: {ast.unparse(node)} -> {ast.unparse(on)}')
        off, test = copy(node), ast.parse(f'_on({len(says) - 1})', mode='eval').body
        node.__class__, node.__dict__ = ast.IfExp, {'test': test, 'body': on, 'orelse': off}
    for path, tree in trees.items():
        path.write_text(ast.unparse(tree) + SWITCH * (path.parts[1:] == ('__init__.py',)))
    out = pytest('-vvrA', '-nauto', '--durations=0', *options.tests, NOTES=f'{folder}/notes')
    took = dict.fromkeys(re.findall('^PASSED (.+)', out, re.MULTILINE), 0.0)
    for seconds, test in re.findall(r'^([\d.]+)s (?:setup|call) +(.+)', out, re.MULTILINE):
        took |= {test: took[test] + float(seconds)} if test in took else {}
    notes = [note.partition(' ')[::2] for note in Path(folder, 'notes').read_text().splitlines()]
    for k, change in enumerate(says):
        past = {test for number, test in notes if number == str(k)}
        files = {test.partition('::')[0] for test in past}
        near = sorted((test not in past, took[test], test) for test in took
                      if '' in files or test.partition('::')[0] in files)
        within = sum(total < 60.0 for total in accumulate(seconds for _, seconds, _ in near))
        out = pytest('-xqq', *(t for *_, t in near[:within]), MUTANT=str(k)) if within else ''
        by = re.findall('^(?:FAILED|ERROR) .{,140}', out, re.MULTILINE)
        caught += bool(by)
        print(change, by or f'- of {within} tests', flush=True)
print(caught, 'of', options.count, 'caught by', len(took), 'tests')
