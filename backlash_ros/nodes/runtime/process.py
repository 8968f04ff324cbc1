"""A node as a process: arguments, start-up, work, events, signals, shutdown, exit code."""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from math import isfinite
from typing import Any, cast

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.exceptions import InvalidHandle, NameValidationException
from rclpy.executors import ExternalShutdownException
from rclpy.logging import LoggingSeverity, get_logger_level, set_logger_level
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.utilities import remove_ros_args

from backlash_ros.core.parameters.errors import ParameterError
from backlash_ros.core.parameters.parameter import as_yaml
from backlash_ros.core.parameters.table import PARAMETERS
from backlash_ros.middleware.loopback import prefer_loopback
from backlash_ros.nodes.runtime.executor import NodeExecutor, make_executor
from backlash_ros.nodes.runtime.parameters import (
    ParameterNode,
    changed_values,
    complaints,
    declare_parameters,
)
from backlash_ros.options import BAD_INPUT, DONE, FAILED, OptionParser

ENABLED = os.environ.get('BACKLASH_ROS_EVENTS') == '1'
START_LOOK_S = 0.01  # between two looks at a condition of start-up
STOP_RETRY_S = 0.1  # between two requests to stop, until the node has heard one
GOODBYE_S = 0.4  # for the middleware to leave the network; a signal ends a node in a second
START_REMIND_S = 5.0  # between two lines that say what start-up waits for
# A wait of the executor costs more than this leaves; sleeping until the tick is more punctual.
NAP_NS = 3_000_000
SIGEV_THREAD = 2  # <signal.h>: the timer calls a function, in a thread of its own


def emit(event: str, **content: object) -> None:
    """Tell the program that started the node of an event: a JSON object in a line of stdout.

    Nothing unless BACKLASH_ROS_EVENTS=1. JSON has no nan: null.
    """
    if ENABLED:
        checked = {
            name: None if isinstance(value, float) and not isfinite(value) else value
            for name, value in content.items()
        }
        print(json.dumps({'event': event, **checked}), flush=True)


def ros_arguments(arguments: Sequence[str]) -> list[str]:
    """The part between --ros-args and --, all of them."""
    found, inside = [], False
    for argument in arguments:
        inside = (inside or argument == '--ros-args') and argument != '--'
        if inside:
            found.append(argument)
    return found


class ProcessNode(ParameterNode):
    """A node that is the purpose of its process: parameters checked, then work until stopped."""

    def __init__(
        self, executable: str, parameters_of: str = '', reconfigurable: bool = False,
    ) -> None:
        """parameters_of: the executable whose parameters it reads. Raises ParameterError.

        reconfigurable: whether parameters may change while the node is unconfigured.
        """
        super().__init__(executable)
        self.begun_at = time.monotonic()  # from here on the node finds others and is found
        self.log = Node.get_logger(self)
        self.settings = declare_parameters(
            self, parameters_of or executable, reconfigurable
        )
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.stopping = False
        self.signals = 0  # SIGINT and SIGTERM that have come
        self.urged = threading.Event()  # a SIGTERM has come after the first one of them
        self.exit_code = DONE
        self.stop_request = self.create_guard_condition(self._stop)

    def listen(
        self, message_type: type[Any], topic: str,
        callback: Callable[[Any, dict[str, Any]], None], qos: QoSProfile | int, raw: bool = False,
    ) -> Subscription:
        """Subscribe with a callback that also gets time stamp and number of the message."""
        # rclpy takes such callbacks but does not say so in its types.
        plain = cast(Callable[[Any], None], callback)
        return self.create_subscription(message_type, topic, plain, qos, raw=raw)

    def set_parameters_atomically(
        self, parameter_list: list[Parameter],
    ) -> SetParametersResult:
        """Set what differs from the present values; values equal to these are accepted."""
        try:
            changes = changed_values(self, parameter_list)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if not changes:
            return SetParametersResult(successful=True)
        return super().set_parameters_atomically(changes)

    def work(self, executor: NodeExecutor) -> None:
        """Do what the node is for until `stopping`."""
        while not self.stopping:
            executor.spin_once()

    def finish(self) -> None:
        """Say what there is to say at the end; called once, whatever ended the work."""

    def call_when(
        self, condition: Callable[[], bool], action: Callable[[], None], awaited: str,
    ) -> None:
        """Call action as soon as condition holds; `awaited` says in the log what is missing."""
        remind = time.monotonic() + START_REMIND_S

        def look() -> None:
            nonlocal remind
            if condition():
                self.destroy_timer(timer)
                action()
            elif time.monotonic() > remind:
                remind += START_REMIND_S
                self.log.info(f'waiting for {awaited}')

        timer = self.create_timer(START_LOOK_S, look, clock=self.steady_clock)

    def _stop(self) -> None:
        self.stopping = True


def spin_paced(
    node: ProcessNode, executor: NodeExecutor, period_s: float,
    tick: Callable[[int, int], bool], idle: Callable[[], bool],
) -> None:
    """Call tick(n, due_ns) n periods after the start, until it returns False or the node stops.

    The deadlines are absolute, so that nothing drifts; where the process is held up past a
    deadline, n jumps. due_ns: the deadline on the monotonic clock. In between messages are
    served, and all else after a tick. idle: says that none is expected before the next tick.
    """
    period_ns = period_s * 1e9
    start = time.monotonic_ns()
    n = -1
    while not node.stopping:
        now = time.monotonic_ns()
        remaining = start + (n + 1) * period_ns - now
        if remaining <= 0:
            # What has arrived in time counts, even if nobody has looked at it yet.
            executor.serve_urgent(0)
            n = max(n + 1, int((time.monotonic_ns() - start) / period_ns))
            if not tick(n, start + int(n * period_ns)):
                return
            executor.look_if_due()
        elif remaining >= NAP_NS:
            executor.spin_once(timeout_sec=remaining * 1e-9)
        elif idle():
            time.sleep(remaining * 1e-9)
        else:
            executor.serve_urgent(int(remaining))


@contextlib.contextmanager
def exit_at_the_latest(within_s: float, code: int) -> Iterator[None]:
    """End the process with this exit code where the block takes longer than within_s [s].

    Fast DDS may hang for good while it takes a participant down, if others leave at the same time
    (DomainParticipant::set_listener spins, seen with 2.14.5: of five participants that leave
    together in one of some 600 exits, with the profile for loopback in one of some 2,800). It does
    so with the interpreter locked: no thread of Python and no handler of a signal would ever run.
    All work is done by then, so a timer of the C library ends the process instead.
    faulthandler.dump_traceback_later would end it too, but with the exit code of a failure.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError):  # nobody may be reading any more
            stream.flush()
    c, timer = ctypes.CDLL(None), ctypes.c_void_p()
    exit_now = ctypes.cast(c._exit, ctypes.c_void_p).value
    # struct sigevent: the argument of the function, signal, kind, function, attributes.
    event = struct.pack('@PiiPP32x', code, 0, SIGEV_THREAD, exit_now, 0)
    # Out of timers, or on another system than Linux: without a last resort.
    armed = sys.platform == 'linux' \
        and c.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(timer)) == 0
    if armed:
        # struct itimerspec: period and delay as seconds and nanoseconds.
        delay = struct.pack('@4l', 0, 0, int(within_s), int(within_s % 1.0 * 1e9))
        c.timer_settime(timer, 0, delay, None)
    try:
        yield
    finally:
        if armed:
            c.timer_delete(timer)


def run(executable: str, make_node: Callable[[], ProcessNode], args: list[str] | None) -> int:
    """Run a node until its work ends, by itself or by SIGINT or SIGTERM; return the exit code.

    That of the node, or 2 for bad input, told in one line on stderr. Any other exception passes.
    """
    signals = _SignalPipe()
    reason = _initialise(args)
    if reason:
        return _refuse(executable, reason)
    try:
        _parse_plain_arguments(executable, make_node, args)
        try:
            node = make_node()
        except (ParameterError, NameValidationException) as error:
            return _refuse(executable, str(error))
        for complaint in complaints(
            sys.argv[1:] if args is None else args, executable, node.get_fully_qualified_name()
        ):
            node.log.warning(complaint)
        signals.stop_at_arrival(node)
        code = FAILED  # unless the work comes to its end
        try:
            executor = make_executor(node, node.log.warning)
            # A full collection would look through all of numpy and scipy and cost many samples.
            gc.collect()
            gc.freeze()
            with contextlib.suppress(ExternalShutdownException):
                node.work(executor)
            code = DONE
        finally:
            node.finish()
            code = node.exit_code or code
            with exit_at_the_latest(GOODBYE_S, code):
                executor.shutdown()
                Node.destroy_node(node)
                rclpy.try_shutdown()
    finally:
        rclpy.try_shutdown()
        # The interpreter gives handlers back before it ends, but leaves what is ignored.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    return code


class _SignalPipe:
    """Turns SIGINT and SIGTERM into a callback of the executor.

    So no callback is torn apart by an exception, and ROS still works when the node says good-bye;
    the handlers of rclpy would raise KeyboardInterrupt anywhere and shut ROS down beneath it.
    """

    def __init__(self) -> None:
        self._read_end, write_end = os.pipe()
        os.set_blocking(write_end, False)
        signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, frame: None)

    def stop_at_arrival(self, node: ProcessNode) -> None:
        """Ask the node to stop when a signal arrives or has arrived since the construction."""
        def wait() -> None:
            while number := os.read(self._read_end, 1):
                node.signals += 1
                if node.signals > 1 and number[0] == signal.SIGTERM:
                    node.urged.set()
                # The node may be ending by itself.
                with contextlib.suppress(InvalidHandle):
                    # An executor that is busy may overlook a single one.
                    while not node.stopping:
                        node.stop_request.trigger()
                        time.sleep(STOP_RETRY_S)

        threading.Thread(target=wait, daemon=True).start()


def _parse_plain_arguments(
    executable: str, make_node: Callable[[], ProcessNode], args: list[str] | None,
) -> None:
    """Refuse what is no argument of ROS; print help where asked for."""
    parser = OptionParser(
        executable, ': parameters are given as --ros-args -p NAME:=VALUE or --params-file FILE',
        usage=f'{executable} [--ros-args -p NAME:=VALUE --params-file FILE ...]',
        description=sys.modules[make_node.__module__].__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter, epilog=_parameter_help(executable),
    )
    parser.parse_args(remove_ros_args(sys.argv[1:] if args is None else args))


def _parameter_help(executable: str) -> str:
    used = [p for p in PARAMETERS if executable in p.used_by]
    return 'parameters, with their defaults (* may change in a running node):\n' + '\n'.join(
        f'{"*" if p.live else " "} {p.name}: {as_yaml(p.default)}\n      {p.description}'
        + (f' [{p.unit}]' if p.unit else '')
        + (f' (one of {", ".join(p.choices)})' if p.choices else '') for p in used
    )


def _initialise(args: list[str] | None) -> str:
    """Initialise ROS; return why that failed, empty if it did not."""
    prefer_loopback(os.environ)
    # rcl would add a line without content to the one that says what is wrong.
    set_logger_level('rcl', LoggingSeverity.FATAL)
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        return _in_one_line(str(error))
    finally:
        if get_logger_level('rcl') == LoggingSeverity.FATAL:
            set_logger_level('rcl', LoggingSeverity.UNSET)
    return ''


def _in_one_line(reason: str) -> str:
    # Where in the sources of rcl it was found helps nobody.
    reason = ' '.join(reason.split(', at /')[0].split())
    if 'Sequence should be of same type' in reason:
        reason += ': write all numbers of a list with a decimal point'
    return reason


def _refuse(executable: str, reason: str) -> int:
    print(f'{executable}: {" ".join(reason.split())}', file=sys.stderr)
    return BAD_INPUT
