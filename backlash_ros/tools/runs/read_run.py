"""Read runs from bags, joined on the sample number, and folders of results; simulate runs."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from backlash_ros import topics
from backlash_ros.bags import REPAIR_COMMAND, BagError, BagReader, Topic, is_bag
from backlash_ros.core.plant.transfer_function import Array
from backlash_ros.core.simulation.closed_loop import ClosedLoop
from backlash_ros.core.simulation.run_record import (
    COLUMNS,
    LearnedModel,
    RunRecord,
    complete_model,
)
from backlash_ros.tools.cli import WHOLE_SPAN, BrokenOffError, InputError, Span
from backlash_ros.tools.config import read_configuration
from backlash_ros.tools.runs import files
from backlash_ros.tools.runs.files import BAG, CONFIG_FILE, RECORD_FILE, SAMPLES_FILE, Run

Messages = list[tuple[int, Any]]  # stamps [ns] and messages, in order of the stamps
# Rows of an array topic: a field for each label, and `stamp` [ns] since the first signals.
Table = NDArray[np.void]

NUMBER, ARRAY = 'std_msgs/msg/Float64', 'std_msgs/msg/Float64MultiArray'  # types of messages


def read_run(
    path: Path, config: Path | None = None, span: Span = WHOLE_SPAN, axis: str = '',
) -> Run:
    """Read a bag, its .mcap or .db3 file, a folder of results, record.npz or samples.csv.

    config: parameters.yaml beside the run if None. axis: one of several. Raises InputError.
    """
    if not path.exists():
        raise InputError(f'{path}: does not exist')
    folder, parameters = path if path.is_dir() else path.parent, None
    # A bag lies in a folder of results, beside the parameters.
    beside = [folder / CONFIG_FILE, *[folder.parent / CONFIG_FILE] * is_bag(path)]
    if config := config or next(filter(Path.is_file, beside), None):
        configuration = read_configuration(config)
        known = axis in (configuration.axes or configuration.joints)
        parameters = configuration.parameters(axis if known else ''.join(configuration.joints[:1]))
    period = parameters.sample_period if parameters else None
    if bag := find_bag(path):
        return read_bag(bag, period, span, axis)._replace(parameters=parameters)
    inside = (path / RECORD_FILE, path / SAMPLES_FILE)
    file = next(filter(Path.is_file, inside), path)
    if not file.is_file() or file.suffix not in ('.npz', '.csv'):
        raise InputError(f'{path}: holds no bag, no {RECORD_FILE} and no {SAMPLES_FILE}: '
                         'name a bag, or the folder of one run of bringup or simulate')
    record = files.read_record(file) if file.suffix == '.npz' else files.read_samples(file, period)
    if span == WHOLE_SPAN:
        return Run(record, parameters)
    t = record.column('t')
    rows = record.rows[(t >= span.from_s) & (t < span.to_s)]
    if not len(rows):
        raise InputError('there is no sample between --from and --to')
    rows[:, COLUMNS.index('t')] -= rows[0, COLUMNS.index('t')]
    # The recorded G is that of the end of the run.
    learned = record.learned if t[-1] < span.to_s else None
    return Run(replace(record, rows=rows, learned=learned), parameters)


def find_bag(path: Path) -> Path | None:
    """The bag at a path or in a folder of results; None if there is none."""
    return next((place for place in (path, path / BAG) if is_bag(place)), None)


def run_loop(loop: ClosedLoop, samples: int) -> RunRecord:
    """Simulate a run; raises BrokenOffError if it cannot go on, as when a signal overflows."""
    try:
        # The controller refuses values that are not finite: numpy need not warn as well.
        with np.errstate(over='ignore', invalid='ignore', divide='ignore'):
            return loop.run(samples)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        reason = 'a signal grew beyond every number' if isinstance(error, OverflowError) \
            else ' '.join(str(error).split())
        raise BrokenOffError(f'the run broke off: {reason}') from error


def read_topics(
    path: Path, wanted: Callable[[Topic], bool],
) -> tuple[dict[str, Messages], list[str], str]:
    """Messages of the wanted topics of a bag by name, all topics, and the damage or ''."""
    types, found, damage = get_typestore(Stores.ROS2_JAZZY), dict[str, Messages](), ''
    try:
        reader = BagReader(path)
        for topic, stamp_ns, raw in reader.messages(wanted):
            # Damaged bytes may make the library raise anything.
            try:
                message = types.deserialize_cdr(raw, topic.message_type)
                found.setdefault(topic.name, []).append((stamp_ns, message))
            except Exception:
                damage = 'is damaged'
    except BagError as error:
        raise InputError(str(error)) from None
    for messages in found.values():
        messages.sort(key=lambda each: each[0])
    if damage := reader.damage or damage:
        if not reader.topics:
            raise InputError(f'{path}: {damage}, and nothing of it can be read')
        damage = (f'{path} {damage}: this is what is left, {sum(map(len, found.values()))} '
                  'messages; once it is not being recorded any more, '
                  f'`{REPAIR_COMMAND} {path}` completes it')
    return found, sorted(topic.name for topic in reader.topics), damage


def choose_namespace(names: Sequence[str], axis: str) -> tuple[str, str]:
    """The topic of an axis among topics that end alike, or ''; and a note about the others."""
    axes = [name.strip('/').split('/')[0] for name in names]
    if axis or not names:
        return names[axes.index(axis)] if axis in axes else '', ''
    others = f'; --axis {axes[-1]} chooses another one' if axes[1:] else ''
    return names[0], others and f'the bag holds {", ".join(names)}: this is {axes[0]}{others}'


def topic_ends_like(name: str, topic: str) -> bool:
    """Whether a recorded topic is this one, in any namespace."""
    return f'/{name}'.endswith(f'/{topic}')


def read_bag(
    path: Path, sample_period: float | None = None, span: Span = WHOLE_SPAN, axis: str = '',
) -> Run:
    """Read the run of the last controller within the span, or what is left of it if damaged.

    sample_period: from the median step of the stamps if None. Raises InputError.
    """
    of_driver = topics.PLANT_OUTPUT, topics.APPLIED_CONTROL
    recorded, names, damage = read_topics(path, lambda topic: topic.message_type == ARRAY or (
        topic.message_type == NUMBER and topic.name.endswith(of_driver)))
    try:
        found, prefix, notes = _of_axis(recorded, names, axis)
        begin_ns = found[topics.SIGNALS][0][0]
        # In lockstep the stamp is the newest tick that the recorder had heard: other messages of
        # the first sample may be stamped before its signals.
        begin = span.from_s * 1e9 if span.from_s > 0.0 else -np.inf
        found = {topic: [(stamp - begin_ns, message) for stamp, message in messages
                         if begin <= stamp - begin_ns < span.to_s * 1e9]
                 for topic, messages in found.items()}
        models = found.pop(topics.MODEL)
        tables, restarted = _last_section([_tabulate(*each, prefix) for each in found.items()])
        signals, estimates, truth = tables
        if not len(signals):
            raise InputError('holds no sample between --from and --to')
        count, of_signals, of_estimates = np.intersect1d(
            signals['sample'], estimates['sample'], assume_unique=True, return_indices=True)
        if not len(count):
            raise InputError(f'no sample has both {topics.SIGNALS} and {topics.ESTIMATES}')
        if sample_period is None:
            steps = np.diff(signals['stamp'][of_signals]) / np.diff(count)
            sample_period = 1e-9 * float(np.median(steps)) if len(steps) else 0.0
            if not sample_period > 0.0:
                raise InputError('its stamps do not show the sample period: give --config')
            notes.append(f'the sample period of {sample_period:.6g} s was taken from the stamps of '
                         'the bag, as no parameters were given')
    except InputError as error:
        raise InputError('; '.join(filter(None, (f'{path}: {error}', damage)))) from None
    heard = np.union1d(signals['sample'], estimates['sample'])
    if unpaired := len(heard) - len(count):
        notes.append(f'{unpaired} samples were left out: only one of signals and estimates is in '
                     'the bag')
    learned = _newest_model(
        [message for stamp, message in models if stamp >= signals['stamp'][0]], prefix)
    signals, estimates = signals[of_signals], estimates[of_estimates]
    columns = {'t': (count - count[0]) * sample_period, **_true_columns(signals, truth), **{
        label: table[label] for table in (signals, estimates) for label in table.dtype.names or ()}}
    record = RunRecord(files.rows_of(columns), sample_period,
                       int(heard[-1] - heard[0]) + 1 - len(heard), learned)
    return Run(record, None, tuple(filter(None, [damage, *notes, restarted])),
               _reports(recorded, columns['y'], axis))


def _reports(recorded: Mapping[str, Messages], y: Array, axis: str) -> list[list[float]]:
    """The reports of applied_control between each output y (N,) and the one before it.

    Empty if there are none, or if not all outputs are found by their values.
    """
    outputs, reports = (recorded.get(choose_namespace(
        sorted(name for name in recorded if topic_ends_like(name, topic)), axis,
    )[0], []) for topic in (topics.PLANT_OUTPUT, topics.APPLIED_CONTROL))
    remaining = iter(outputs if reports else ())
    stamps = [next((stamp for stamp, message in remaining if message.data == value), -1)
              for value in y.tolist()]
    if -1 in stamps:
        return []
    ends = np.searchsorted([stamp for stamp, _ in reports], stamps, side='right')
    values = np.array([message.data for _, message in reports])
    return [[], *(part.tolist() for part in np.split(values, ends)[1:-1])]


def _of_axis(
    recorded: dict[str, Messages], all_names: Sequence[str], axis: str,
) -> tuple[dict[str, Messages], str, list[str]]:
    """Messages of one axis by topic, the prefix of its labels if it is a joint, and notes."""
    found: dict[str, Messages] = {}
    prefix, notes = '', list[str]()
    labels_of = {name: _labels(messages[0][1]) for name, messages in recorded.items()
                 if messages[0][1].__msgtype__ == ARRAY}
    for topic, labels in topics.LABELS_OF.items():  # signals first
        # Found by their labels, as nodes may have been renamed.
        names = sorted(name for name, given in labels_of.items()
                       if topic_ends_like(name, topic.rpartition('/')[2])
                       and {*labels} <= {label.rpartition('.')[2] for label in given})
        if topic == topics.SIGNALS and names:
            joints = list(dict.fromkeys(
                label.partition('.')[0] for label in labels_of[names[0]] if '.' in label))
            if joints and axis in ('', *joints):
                if not axis and joints[1:]:
                    notes = [f'this is joint {joints[0]}; --axis chooses one of '
                             f'{", ".join(joints[1:])}']
                prefix, axis = f'{axis or joints[0]}.', ''
        name, note = choose_namespace(names, axis)
        if not name and topic in (topics.SIGNALS, topics.ESTIMATES):
            raise InputError(f'holds no message of {topic}{axis and " of axis "}{axis}; its topics '
                             f'are {", ".join(all_names) or "none"}')
        if note:
            axis, notes = name.strip('/').split('/')[0], [*notes, note]
        found[topic] = recorded.get(name, [])
    return found, prefix, notes


def _labels(message: Any) -> list[str]:
    return [each.label for each in message.layout.dim]


def _tabulate(topic: str, messages: Messages, prefix: str) -> Table:
    """Rows of the messages of a topic; if it has several joints, of the one with this prefix."""
    labels = topics.LABELS_OF[topic]
    table = np.zeros(len(messages), [(label, float) for label in (*labels, 'stamp')])
    if not messages:  # as for the truth of a real plant
        return table
    given = _labels(messages[0][1])
    if any(len(message.data) != len(given) for _, message in messages):
        raise InputError(f'{topic} has a message without a value for each label')
    values = np.array([message.data for _, message in messages])
    for label in labels:
        table[label] = values[:, given.index(prefix + label)]
    table['stamp'] = [stamp for stamp, _ in messages]
    # A joint without a step has a row of nan.
    return table[~np.isnan([table[label] for label in labels]).all(axis=0)] if prefix else table


def _last_section(tables: list[Table]) -> tuple[list[Table], str]:
    """Rows of the last run, one per sample; and a note on what was left out, or ''."""
    signals, note = tables[0], ''
    restarts = np.flatnonzero(np.diff(signals['sample']) <= 0) + 1
    # If the count falls back that often, two nodes are at work.
    if len(restarts) > 0.1 * len(signals):
        note = 'two controllers published at once: the first row of each sample is used'
    elif len(restarts):
        cut = signals['stamp'][restarts[-1]]
        note = ('the controller restarted its count: this is what follows the last restart, '
                f'{cut * 1e-9:.1f} s after the beginning; --from and --to choose another part')
        # Signals are cut by rows, as stamps of simulated time may be equal.
        tables = [signals[restarts[-1]:], *(each[each['stamp'] >= cut] for each in tables[1:])]
    return [each[np.unique(each['sample'], return_index=True)[1]] for each in tables], note


def _true_columns(signals: Table, truth: Table) -> dict[str, Array]:
    """Columns of the truth: u, nan where not recorded, as for the last v, and the true backlash."""
    if not len(truth):
        return {}
    count, sample = signals['sample'], truth['sample']
    if not np.intersect1d(count, sample).size:
        # A controller that was started later counts from another number: equal v tell the offset.
        _, here, there = np.intersect1d(signals['v'], truth['v'], return_indices=True)
        if len(here):
            sample = sample + np.quantile(count[here] - sample[there], 0.5, method='lower')
    _, here, there = np.intersect1d(count, sample, assume_unique=True, return_indices=True)
    u = np.full(len(count), np.nan)
    u[here] = truth['u'][there]
    newest = np.maximum(np.searchsorted(sample, count, side='right') - 1, 0)
    return {'u': u, **{f'true_{name}': truth[name][newest] for name in topics.BACKLASH}}


def _newest_model(messages: Sequence[Any], prefix: str) -> LearnedModel | None:
    """The last complete G in the messages that is not all nan; None if there is none."""
    for message in reversed(messages):
        ends = np.cumsum([each.size for each in message.layout.dim])
        parts = zip(_labels(message), np.split(message.data, ends), strict=False)
        fields = {label.removeprefix(prefix): values.tolist() for label, values in parts
                  if label.startswith(prefix)}
        model = complete_model(fields)
        if model and not all(map(isnan, chain(*model.values()))):
            return model
    return None
