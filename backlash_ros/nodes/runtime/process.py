"""Run a node as a process: arguments, start-up, work, events, signals, shutdown, exit code."""

import argparse
import contextlib
import ctypes
import difflib
import gc
import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from math import isfinite
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.exceptions import NameValidationException
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.time import Time
from rclpy.timer import Timer
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from backlash_ros.core.parameters import (
    BY_NAME,
    CONTROLLER,
    UNTOLD,
    ParameterError,
    Parameters,
    Value,
    as_yaml,
    check_value,
    entry_of,
)
from backlash_ros.middleware import prefer_loopback
from backlash_ros.nodes.runtime.executor import Polled, PromptExecutor
from backlash_ros.options import BAD_INPUT, DONE, FAILED, OptionParser
from backlash_ros.topics import CLOCK, DIAGNOSTICS

LARGEST_DOMAIN = 232  # that UDP ports are left for
ENABLED = os.environ.get('BACKLASH_ROS_EVENTS') == '1'


def emit(event: str, **content: object) -> None:
    """Print an event as a line of JSON for the parent process, if BACKLASH_ROS_EVENTS=1."""
    if ENABLED:
        print(json.dumps({'event': event} | {
            # JSON has no nan.
            name: None if isinstance(value, float) and not isfinite(value) else value
            for name, value in content.items()
        }), flush=True)


def split_arguments(args: list[str] | None) -> tuple[list[str], list[str]]:
    """Split arguments into those that are not for ROS, and those from --ros-args to --."""
    arguments, of_ros, inside = sys.argv[1:] if args is None else args, [], False
    for argument in arguments:
        inside = (inside or argument == '--ros-args') and argument != '--'
        if inside:
            of_ros.append(argument)
    return remove_ros_args(['', *arguments])[1:], of_ros


class ProcessNode(Node):
    """A node with a process of its own: checks its parameters, then works until it is stopped.

    Its `settings` are complete and checked; a change applies as a whole or not at all.
    parameters_of: executable whose parameters it has. signals: the SIGINT and SIGTERM received.
    """

    settings: Parameters
    reconfigurable = False  # whether all but fixed parameters may change while it is unconfigured
    configured = False  # whether, of these, only live parameters may change now

    def __init__(self, executable: str, parameters_of: str = '') -> None:
        super().__init__(executable)
        self.log = Node.get_logger(self)
        self.declare_settings(parameters_of or executable)
        self.signals: list[int] = []
        self.exit_code = DONE

    def check_change(self, p: Parameters) -> None:
        """Raise ParameterError for values that the node cannot use now."""

    def take_up(self, before: Parameters) -> None:
        """Use the settings, which have just changed."""

    @property
    def stopping(self) -> bool:
        return bool(self.signals)

    def count_publishers(self, topic_name: str) -> int:
        # rclpy does not remap the name before it counts.
        return super().count_publishers(self.resolve_topic_name(topic_name))

    def every(self, period_s: float, action: Callable[[], Any]) -> Timer:
        """Call action every period_s [s] of the steady clock."""
        return self.create_timer(period_s, action, clock=RosClock(clock_type=ClockType.STEADY_TIME))

    def listen(
        self, message_type: type[Any], topic: str, callback: Callable[[Any, Any], None],
        qos: QoSProfile | int, raw: bool = False, polled: bool = False,
    ) -> Subscription:
        """Subscribe; callback gets messages and their info. polled: only in serve_polled."""
        # rclpy accepts such callbacks, but its types do not.
        untyped: Any = callback
        group: Any = Polled
        return self.create_subscription(
            message_type, topic, untyped, qos, raw=raw, callback_group=group() if polled else None
        )

    def listen_to_clock(self, hear: Callable[[int], object], qos: QoSProfile | int) -> None:
        """Call hear with the simulated time [ns] of each tick."""
        def hear_tick(tick: Clock) -> None:
            hear(Time.from_msg(tick.clock).nanoseconds)

        self.create_subscription(Clock, CLOCK, hear_tick, qos)

    def listen_to_diagnostics(
        self, hear: Callable[[DiagnosticStatus, dict[str, str], int], None],
    ) -> Subscription:
        """Call hear with each status, its values by key, and its arrival [ns]; it is polled."""
        def hear_all(message: DiagnosticArray, info: dict[str, Any]) -> None:
            for status in message.status:
                values = {each.key: each.value for each in status.values}
                hear(status, values, info['received_timestamp'])

        # From all nodes of the domain, of which some robots have many.
        return self.listen(DiagnosticArray, DIAGNOSTICS, hear_all, 100, polled=True)

    def work(self, executor: PromptExecutor) -> None:
        """Work until `stopping`; nodes override this."""
        while not self.stopping:
            executor.spin_once()

    def finish(self) -> None:
        """Close and report; called once at the end, whatever ended the work."""

    def wait_until(
        self, executor: PromptExecutor, condition: Callable[[], object], awaited: str,
    ) -> bool:
        """Spin until condition holds; returns False if a signal came. awaited: for the log."""
        remind = time.monotonic() + 5.0
        while not (self.stopping or condition()):
            executor.spin_once(timeout_sec=0.01)
            if time.monotonic() > remind:
                remind += 5.0
                self.log.info(f'waiting for {awaited}')
        return not self.stopping

    def declare_settings(self, executable: str) -> None:
        """Declare the parameters that the table has for this executable; raises ParameterError."""
        # rclpy has no other way to get all names that were given; it declares two of them itself.
        given = {
            name: _given_value(parameter)
            for name, parameter in self.handle.get_parameters(RosParameter).items()
            if name not in ('use_sim_time', 'start_type_description_service')
        }
        self.settings = parameters = Parameters(given)
        values = {p.name: parameters[p.name] for p in BY_NAME.values() if executable in p.used_by}
        if executable == CONTROLLER:
            # Of the joints' own parameters only those that were given: there are hundreds.
            values |= {
                name: parameters.of_joint(joint)[own] for name in given
                for joint, _, own in [name.partition('.')] if joint in parameters.joint_names
            }
        # If one value were missing, rclpy would return none of those it is asked for. An empty list
        # gets its type here.
        for name in values:
            self.declare_parameter(
                name, descriptor=ParameterDescriptor(dynamic_typing=True), ignore_override=True
            )
        present = [_ros_parameter(name, value) for name, value in values.items()]
        super().set_parameters_atomically(present)
        for parameter in present:
            entry = entry_of(parameter.name)
            assert entry is not None
            self.set_descriptor(parameter.name, ParameterDescriptor(
                name=parameter.name, type=_ros_parameter(entry.name, entry.default).type_.value,
                description=entry.description + (f' [{entry.unit}]' if entry.unit else ''),
                additional_constraints='one of ' + ', '.join(entry.choices) if entry.choices
                else entry.rules,
                read_only=entry.change not in ('live', *['unconfigured'] * self.reconfigurable),
            ))

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set parameters that differ from the present values, in their declared types.

        Command-line tools send 1e-6 as text, and load whole files whose values are mostly the same.
        """
        changes, values = [], {}
        try:
            for change in parameter_list:
                name, entry = change.name, entry_of(change.name)
                present = self.get_parameter_or(name).value
                if entry is None or present is None:
                    changes += [change] * (present is None or change.value != present)
                elif (value := check_value(entry, _given_value(change))) \
                        != check_value(entry, present):
                    if entry.change == 'unconfigured' and self.configured:
                        raise ParameterError(
                            name, UNTOLD, 'is read-only while the node is configured',
                            'deactivate it and clean it up first',
                        )
                    changes.append(_ros_parameter(name, value))
                    values[name] = value
            if not changes:
                return SetParametersResult(successful=True)
            settings = self.settings.replaced(values)
            self.check_change(settings)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(changes)
        if result.successful:
            before, self.settings = self.settings, settings
            self.take_up(before)
        return result


def run(
    executable: str, make_node: Callable[[], ProcessNode], args: list[str] | None = None,
) -> int:
    """Run a node until its work or a signal ends it; return its exit code, or 2 for bad input."""
    arguments = sys.argv[1:] if args is None else args
    signals: list[int] = []
    # The handlers of rclpy would raise KeyboardInterrupt anywhere and shut ROS down before the node
    # has finished.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: signals.append(number))
    try:
        try:
            _initialise(arguments)
            OptionParser(
                executable,
                usage=f'{executable} [--ros-args -p NAME:=VALUE --params-file FILE ...]',
                description=sys.modules[make_node.__module__].__doc__,
                formatter_class=argparse.RawDescriptionHelpFormatter,
                epilog='parameters, with their defaults (* may change in a running node):'
                + ''.join(f'\n{"* " if p.change == "live" else "  "}{p.name}: '
                          f'{as_yaml(p.default)}\n      {p.description}'
                          for p in BY_NAME.values() if executable in p.used_by),
            ).parse_args(remove_ros_args(arguments))
            node = make_node()
        except (ParameterError, NameValidationException) as error:
            print(f'{executable}: {" ".join(str(error).split())}', file=sys.stderr)
            return BAD_INPUT
        for option, file in pairwise(arguments):
            if option == '--params-file' and (
                    complaint := unreached(file, executable, node.get_fully_qualified_name())):
                node.log.warning(complaint)
        node.signals = signals
        executor = PromptExecutor(node)
        code = FAILED  # unless the work ends
        try:
            # A full collection would look through all of numpy and scipy and cost many samples.
            gc.collect()
            gc.freeze()
            node.work(executor)
            code = DONE
        except BrokenPipeError:  # nobody reads any more, as in `monitor | head`
            # Otherwise Python reports it again when it flushes at exit.
            sys.stdout, code = open(os.devnull, 'w'), DONE  # noqa: SIM115
        finally:
            node.finish()
            code = node.exit_code or code
            # Time for the middleware to leave the network; a signal ends a node within a second.
            with exit_at_the_latest(0.4, code):
                executor.shutdown()
                Node.destroy_node(node)
                rclpy.try_shutdown()
    finally:
        rclpy.try_shutdown()
        # The interpreter resets handlers before it ends, but not ignored signals.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return code


@contextlib.contextmanager
def exit_at_the_latest(within_s: float, code: int) -> Iterator[None]:
    """End the process with this exit code if the block takes longer than within_s [s].

    When participants leave together, Fast DDS 2.14 hangs for good in one of some hundreds of exits,
    with the interpreter locked, so that no Python thread or signal handler would run. All work is
    done by then, so a timer of the C library ends the process instead.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):  # the reader may have gone
            stream.flush()
    c, timer = ctypes.CDLL(None), ctypes.c_void_p()
    exit_now = ctypes.cast(c._exit, ctypes.c_void_p).value
    # struct sigevent: the argument of the function, signal, kind, function, attributes.
    thread = 2  # SIGEV_THREAD of <signal.h>: the timer calls a function, in a thread of its own
    event = struct.pack('@PiiPP32x', code, 0, thread, exit_now, 0)
    # struct itimerspec: period and delay as seconds and nanoseconds.
    delay = struct.pack('@4l', 0, 0, int(within_s), int(within_s % 1.0 * 1e9))
    c.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(timer))
    c.timer_settime(timer, 0, delay, None)
    try:
        yield
    finally:
        c.timer_delete(timer)


def _initialise(arguments: list[str]) -> None:
    prefer_loopback(os.environ)
    domain = os.environ.get('ROS_DOMAIN_ID', '')
    if domain.isdecimal() and int(domain) > LARGEST_DOMAIN:
        raise ParameterError('ROS_DOMAIN_ID', domain, f'is more than {LARGEST_DOMAIN}',
                             'set a smaller one')
    # rcl would add a useless line to the one that says what is wrong.
    set_logger_level('rcl', LoggingSeverity.FATAL)
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        # Leave out the place in the sources of rcl.
        reason = str(error).split(', at /')[0]
        if 'Sequence should be of same type' in reason:
            reason += ': write all numbers of a list with a decimal point'
        raise ParameterError('ROS', UNTOLD, f'cannot begin: {reason}') from None
    finally:
        set_logger_level('rcl', LoggingSeverity.UNSET)


def _given_value(parameter: RosParameter) -> object:
    if parameter.value is not None:
        return parameter.value
    entry = entry_of(parameter.name)
    if entry is not None and (entry.names or entry.default == ()):
        return ()
    raise ParameterError(parameter.name, UNTOLD, 'has no value', 'give it one or leave it out')


def _ros_parameter(name: str, value: Value) -> RosParameter:
    kind, entry = RosParameter.Type, entry_of(name)
    if value == () and entry:
        return RosParameter(name, kind.STRING_ARRAY if entry.names else kind.DOUBLE_ARRAY, [])
    return RosParameter(name, value=list(value) if isinstance(value, tuple) else value)


def unreached(file: str, executable: str, full_name: str) -> str:
    """A complaint if sections of a file seem to be meant for a node but do not reach it, or ''."""
    import yaml  # most nodes start without a file

    try:
        content = yaml.safe_load(Path(file).read_text(encoding='utf-8')) or ()
    except (yaml.YAMLError, ValueError):  # ROS 2 has taken it all the same
        return ''
    namespace, _, own = full_name.strip('/').rpartition('/')
    meant = [section for section in (str(name).strip('/') for name in content) if
             difflib.get_close_matches(section.rpartition('/')[2], [own, executable], cutoff=0.8)]
    reaching = {f'**/{own}', f'*/{own}', full_name.strip('/')}
    # A section with a namespace may be for another axis.
    passed_over = [section for section in meant if not (namespace and '/' in section)]
    if not passed_over or not reaching.isdisjoint(meant):
        return ''
    return f'{file}: section {", ".join(passed_over)} is not for {full_name}, its values are not ' \
        f'used: write /**/{own}'
