"""Follow running controllers, found by what they publish: their state and newest messages."""

import re
import time
from argparse import RawDescriptionHelpFormatter
from collections import deque
from collections.abc import Sequence
from functools import partial
from math import inf, nan
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.subscription import Subscription
from std_msgs.msg import Float64

from backlash_ros.core.priority import give_way
from backlash_ros.nodes.runtime.executor import serve_polled
from backlash_ros.nodes.runtime.messages import SILENT_S
from backlash_ros.nodes.runtime.process import ProcessNode
from backlash_ros.options import OptionParser
from backlash_ros.topics import BACKLASH


class ControllerState:
    """The state of one controller, or of a joint of it.

    estimates: value and two standard deviations. watched: by label, the time of arrival [ns] and
    the value of each message taken at the last look.
    """

    def __init__(self, node: str, joint: str = '') -> None:
        self.node = node
        self.name = f'{node}: {joint}' if joint else node  # as /diagnostics calls it
        self.subscriptions: list[Subscription] = []  # polled ones
        self.watched: dict[str, list[tuple[int, float]]] = {}
        self.message, self._level = '', 0
        self._heard_at_s = -inf  # on the steady clock
        self.values: dict[str, str] = {}
        self.estimates = dict.fromkeys(BACKLASH, (nan, nan))
        self.events: deque[tuple[str, str]] = deque(maxlen=20)

    def hear(self, message: str, level: int, values: dict[str, str], now_s: float) -> None:
        """Take a status from /diagnostics; a changed text is noted as an event."""
        # A text in which only a figure has changed is not new.
        before, after = (re.sub(r'[\d.]+', '', text) for text in (self.message, message))
        if after != before:
            self.note(message)
        self.message, self._level = message, min(level, 2)
        self._heard_at_s, self.values = now_s, values
        for name in BACKLASH:
            self.estimates[name] = self.number(name), 2.0 * self.number(f'std_{name}')

    def hear_value(self, label: str, message: Float64, info: dict[str, Any]) -> None:
        self.watched.setdefault(label, []).append((info['received_timestamp'], message.data))
        if label in BACKLASH:
            self.estimates[label] = message.data, self.estimates[label][1]

    def note(self, text: str) -> None:
        self.events.append((time.strftime('%H:%M:%S'), text))

    def number(self, key: str) -> float:
        try:
            return float(self.values.get(key, ''))
        except ValueError:
            return nan

    def is_on(self, key: str) -> bool:
        return self.values.get(key) == 'True'

    @property
    def silent_s(self) -> float:
        """How long it has been silent [s]; 0 if that is not unusual yet."""
        passed = time.monotonic() - self._heard_at_s
        return passed if SILENT_S < passed < inf else 0.0

    @property
    def level(self) -> int:
        """0 well, 1 warning, 2 error or silent."""
        return 2 if self.silent_s else self._level

    @property
    def word(self) -> str:
        if not self.message:
            return 'no diagnostics yet'
        if silent_s := self.silent_s:
            return f'silent for {silent_s:.0f} s'
        # The state of the estimates at deactivation is not the state of the controller.
        beginning = self.message.partition(':')[0]
        return beginning if beginning == 'inactive' else self.values.get('state') or beginning


class ViewerNode(ProcessNode):
    """Finds and follows all controllers of the domain, or those of the wanted namespaces.

    labels: which messages below `controller/watch` to take. states: by name, in the order in which
    the controllers were found.
    """

    def __init__(self, name: str, wanted: Sequence[str], labels: Sequence[str]) -> None:
        give_way()
        super().__init__(name)
        self._labels = labels
        self._wanted = tuple(f'/{each.strip("/")}/'.replace('//', '/') for each in wanted) or '/'
        which = ' of ' + ', '.join(wanted) if wanted else ''
        self.awaited = f'waiting for a controller{which} in ROS_DOMAIN_ID=' \
            f'{self.context.get_domain_id()}: bringup prints which one it uses'
        self.states: dict[str, ControllerState] = {}
        self._diagnostics = self.listen_to_diagnostics(self._hear)
        self.every(1.0, self._find)
        self._find()

    def take_messages(self) -> None:
        """Take all messages since the last call; the process is not woken up for each of them."""
        serve_polled(self._diagnostics)
        for state in self.states.values():
            state.watched.clear()
            for subscription in state.subscriptions:
                serve_polled(subscription)

    def _hear(self, status: DiagnosticStatus, values: dict[str, str], received_ns: int) -> None:
        if state := self.states.get(f'/{status.name}'):
            state.hear(status.message, ord(status.level), values, time.monotonic())

    def _find(self) -> None:
        """Find new controllers by the topics that they publish."""
        for topic, _ in sorted(self.get_topic_names_and_types()):
            # Every controller, or joint of it, has this topic.
            found = re.fullmatch(rf'(.*)/watch/(?:([^/]+)/)?{BACKLASH[0]}', topic)
            if found is None or not f'{found[1]}/'.startswith(self._wanted):
                continue
            state = ControllerState(found[1], found[2] or '')
            if state.name not in self.states:
                folder = topic.removesuffix(BACKLASH[0])
                # Deep enough that a stall of a second loses no point.
                state.subscriptions = [self.listen(
                    Float64, folder + label, partial(state.hear_value, label), 30, polled=True
                ) for label in self._labels]
                self.states[state.name] = state


def viewer_options(name: str, description: str | None, epilog: str) -> OptionParser:
    parser = OptionParser(name, description=description, epilog=epilog,
                          formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument('name', nargs='*', metavar='NAME',
                        help='a controller or a namespace, as /pan (default: all there are)')
    return parser
