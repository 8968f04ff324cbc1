"""Bags as the recorder writes them, of runs that were simulated."""

from collections.abc import Iterator, Mapping
from math import nan
from pathlib import Path
from types import MappingProxyType

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from backlash_ros import topics
from backlash_ros.core.loop.learned_model import LearnedModel
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.simulation.run_record import COLUMNS, RunRecord

PARAMETERS = Parameters({'estimator.law': 'lms', 'output_noise_std': 1e-4})
LATENCY_S = 0.0004
TYPES = get_typestore(Stores.ROS2_JAZZY)
MULTI_ARRAY = 'std_msgs/msg/Float64MultiArray'


def multi_array(labels: tuple[str, ...], values: list[float]) -> bytes:
    dimension = TYPES.types['std_msgs/msg/MultiArrayDimension']
    layout = TYPES.types['std_msgs/msg/MultiArrayLayout'](
        dim=[dimension(label=label, size=1, stride=0) for label in labels], data_offset=0
    )
    message = TYPES.types[MULTI_ARRAY](layout=layout, data=np.array(values, dtype=np.float64))
    return bytes(TYPES.serialize_cdr(message, MULTI_ARRAY))


def rows_of(
    run: RunRecord, labels: tuple[str, ...], skipped: frozenset[int], prefix: str = '',
    first: int = 1,
) -> Iterator[tuple[int, bytes]]:
    """Number and message of each row, whose samples are counted from `first`."""
    for k in range(run.samples):
        if k in skipped:
            continue
        known = dict(zip(COLUMNS, run.rows[k].tolist(), strict=True))
        known |= {'sample': float(k + first), 'latency_s': LATENCY_S, 'std_f': nan}
        values = [known.get(prefix + label, known.get(label, nan)) for label in labels]
        yield k, multi_array(labels, values)


def write_bag(
    path: Path, run: RunRecord, storage: StoragePlugin = StoragePlugin.MCAP, *,
    truth: bool = True, lost: frozenset[int] = frozenset(), namespace: str = '',
    unpaired: frozenset[int] = frozenset(), models: Mapping[int, bytes] = MappingProxyType({}),
) -> Path:
    """Write a bag as the recorder does; the last sample has no truth, its v was never applied."""
    period_ns = round(run.sample_period * 1e9)
    with Writer(path, version=9, storage_plugin=storage) as writer:
        sources = [
            (topics.SIGNALS, topics.SIGNAL_LABELS, lost, ''),
            (topics.ESTIMATES, topics.ESTIMATE_LABELS, lost | unpaired, ''),
        ]
        if truth:
            never_applied = frozenset({run.samples - 1})
            sources.append((topics.TRUTH, topics.TRUTH_LABELS, never_applied, 'true_'))
        for topic, labels, skipped, prefix in sources:
            connection = writer.add_connection(
                f'/{namespace}{topic}', MULTI_ARRAY, typestore=TYPES)
            for k, raw in rows_of(run, labels, skipped, prefix):
                writer.write(connection, 10**18 + k * period_ns, raw)
        if models:
            connection = writer.add_connection(
                f'/{namespace}{topics.MODEL}', MULTI_ARRAY, typestore=TYPES)
            for k, raw in models.items():
                writer.write(connection, 10**18 + k * period_ns, raw)
    return path


def believed(denominator: list[float], tail: int = 0) -> bytes:
    """A message of controller/model; tail: numbers at its end that are missing."""
    fields = LearnedModel((0.1,), tuple(denominator), 1, (0.1,) * 5, 1.2, 0.03).fields()
    dimension = TYPES.types['std_msgs/msg/MultiArrayDimension']
    layout = TYPES.types['std_msgs/msg/MultiArrayLayout'](dim=[
        dimension(label=label, size=len(values), stride=0) for label, values in fields.items()
    ], data_offset=0)
    data = [value for values in fields.values() for value in values]
    message = TYPES.types[MULTI_ARRAY](layout=layout, data=np.array(data[:len(data) - tail]))
    return bytes(TYPES.serialize_cdr(message, MULTI_ARRAY))
