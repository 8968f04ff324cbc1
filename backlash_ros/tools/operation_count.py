"""Counts the arithmetic of a controller step: what the interpreter does and what numpy does.

Two counts are added. Arithmetic of single numbers: binary operations (+ - * / ** @ and their
likes) that the interpreter executes in backlash_ros.core. Arithmetic of arrays: the operations of
numpy that these stand for, measured by running the same step once more with arrays that count
their own element-wise operations and matrix products. Calls into scipy and the logic around the
arithmetic are not counted.
"""

from __future__ import annotations

import copy
import dis
import sys
from collections.abc import Callable
from types import CodeType, FrameType
from typing import Any

import numpy as np

CORE = 'backlash_ros/core/'


class _Counter:
    total = 0


class _CountingArray(np.ndarray[Any, Any]):
    """An array that adds each element-wise operation and matrix product to the counter."""

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, **options: Any,
    ) -> Any:
        plain = [_plain(value) for value in inputs]
        if out is not None:
            options['out'] = tuple(_plain(value) for value in out)
        result = getattr(ufunc, method)(*plain, **options)
        size = np.size(result)
        if ufunc is np.matmul:
            size *= 2 * np.shape(plain[0])[-1]
        elif method == 'reduce':
            size = np.size(plain[0])
        _Counter.total += int(size)
        if isinstance(result, np.ndarray) and result.dtype.kind == 'f':
            return result.view(_CountingArray)
        return result


def _plain(value: Any) -> Any:
    return value.view(np.ndarray) if isinstance(value, _CountingArray) else value


def array_operations(subject: Any, step: Callable[[Any], object]) -> int:
    """Operations on arrays in step(subject); a copy of subject is stepped."""
    counted = _counting(copy.deepcopy(subject), set())
    _Counter.total = 0
    step(counted)
    return _Counter.total


def _counting(value: Any, seen: set[int]) -> Any:
    """The same object with every array in it, however deep, replaced by one that counts."""
    if isinstance(value, np.ndarray):
        return value.view(_CountingArray) if value.dtype.kind == 'f' else value
    if id(value) in seen or not type(value).__module__.startswith('backlash_ros.core'):
        return value
    seen.add(id(value))
    for name, inner in list(getattr(value, '__dict__', {}).items()):
        object.__setattr__(value, name, _counting(inner, seen))
    return value


def scalar_operations(subject: Any, step: Callable[[Any], object]) -> int:
    """Binary operations that the interpreter executes in the core during step(subject)."""
    count = 0
    places: dict[CodeType, frozenset[int]] = {}

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        code = frame.f_code
        if CORE not in code.co_filename.replace('\\', '/'):
            return None
        if code not in places:
            places[code] = _arithmetic(code)
            frame.f_trace_opcodes = True
        frame.f_trace_opcodes = True
        if event == 'opcode' and frame.f_lasti in places[code]:
            count += 1
        return trace

    stepped = copy.deepcopy(subject)
    before = sys.gettrace()
    sys.settrace(trace)
    try:
        step(stepped)
    finally:
        sys.settrace(before)
    return count


def _arithmetic(code: CodeType) -> frozenset[int]:
    """Offsets of the binary operations of a code object."""
    return frozenset(
        instruction.offset for instruction in dis.get_instructions(code)
        if instruction.opname.startswith(('BINARY_', 'INPLACE_'))
        and 'SUBSCR' not in instruction.opname and 'SLICE' not in instruction.opname
    )
