"""Bags as the recorder writes them, of runs that were simulated."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import nan
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from backlash_ros import topics
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, MODEL_LABELS, RunRecord

PARAMETERS = Parameters({'estimator.law': 'lms', 'output_noise_std': 1e-4})
LATENCY_S = 0.0004
TYPES = get_typestore(Stores.ROS2_JAZZY)
MULTI_ARRAY = 'std_msgs/msg/Float64MultiArray'
FLOAT = 'std_msgs/msg/Float64'


def write_messages(
    path: Path, messages: Iterable[tuple[int, str, str, bytes]],
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Write a bag of messages: stamp, topic, type, content; in the order of their stamps."""
    connections: dict[str, Any] = {}
    with Writer(path, version=9, storage_plugin=storage) as writer:
        for stamp_ns, topic, kind, raw in sorted(messages, key=lambda message: message[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(f'/{topic}', kind, typestore=TYPES)
            writer.write(connections[topic], stamp_ns, raw)
    return path


def float_message(value: float) -> bytes:
    return bytes(TYPES.serialize_cdr(TYPES.types[FLOAT](data=value), FLOAT))


def multi_array(parts: Mapping[str, Sequence[float]]) -> bytes:
    dimension = TYPES.types['std_msgs/msg/MultiArrayDimension']
    layout = TYPES.types['std_msgs/msg/MultiArrayLayout'](dim=[
        dimension(label=label, size=len(values), stride=0) for label, values in parts.items()
    ], data_offset=0)
    data = np.array([value for values in parts.values() for value in values], dtype=np.float64)
    return bytes(TYPES.serialize_cdr(TYPES.types[MULTI_ARRAY](layout=layout, data=data),
                                     MULTI_ARRAY))


def rows_of(
    run: RunRecord, labels: tuple[str, ...], skipped: frozenset[int], prefix: str = '',
    first: int = 1,
) -> Iterator[tuple[int, bytes]]:
    for k in range(run.samples):
        if k in skipped:
            continue
        known = dict(zip(COLUMNS, run.rows[k].tolist(), strict=True))
        known |= {'sample': float(k + first), 'latency_s': LATENCY_S, 'std_f': nan}
        yield k, multi_array({
            label: [known.get(prefix + label, known.get(label, nan))] for label in labels})


def write_bag(
    path: Path, run: RunRecord, storage: StoragePlugin = StoragePlugin.MCAP, *,
    truth: bool = True, lost: frozenset[int] = frozenset(), namespace: str = '',
    unpaired: frozenset[int] = frozenset(), models: Mapping[int, bytes] = MappingProxyType({}),
) -> Path:
    """Write a bag as the recorder does; the last sample has no truth, its v was never applied."""
    sources = [(topics.SIGNALS, topics.SIGNAL_LABELS, lost, ''),
               (topics.ESTIMATES, topics.ESTIMATE_LABELS, lost | unpaired, '')]
    if truth:
        never_applied = frozenset({run.samples - 1})
        sources.append((topics.TRUTH, topics.TRUTH_LABELS, never_applied, 'true_'))
    rows = [(k, topic, raw) for topic, labels, skipped, prefix in sources
            for k, raw in rows_of(run, labels, skipped, prefix)]
    rows += [(k, topics.MODEL, raw) for k, raw in models.items()]
    return write_messages(path, (
        (10**18 + k * round(run.sample_period * 1e9), f'{namespace}{topic}', MULTI_ARRAY, raw)
        for k, topic, raw in rows), storage)


def believed(denominator: list[float]) -> bytes:
    fields = {**dict.fromkeys(MODEL_LABELS, (0.1,)), 'denominator': denominator}
    return multi_array({**fields, MODEL_LABELS[-1]: []})
