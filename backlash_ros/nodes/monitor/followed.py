"""Controllers that are there: found by what they publish, their state, their newest messages."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress

from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.nodes.monitor.state import ControllerState
from backlash_ros.nodes.runtime.inbox import Inbox
from backlash_ros.nodes.runtime.spin import ProcessNode
from backlash_ros.topics import BACKLASH

NICENESS = 10  # of a process that only shows: the loop comes first
# By which a controller is known, or a joint of it.
WATCHED = re.compile(rf'(?P<node>.*)/watch/((?P<joint>[^/]+)/)?{BACKLASH[0]}')


def give_way() -> None:
    """Let the loop come first; before a thread is started, which inherits it."""
    os.nice(NICENESS)
    # Niceness counts only among the processes of one session, see autogroup in sched(7). In this
    # class whoever wakes up does not interrupt one that runs, whatever session that is of.
    if hasattr(os, 'SCHED_BATCH'):
        with suppress(OSError):  # some containers do not allow it
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


class Followed:
    """State of one controller, or of one joint of it, and its messages below `controller/watch`.

    labels: which of these, m, c_r and c_l among them. depth: how many of each may wait.
    """

    def __init__(
        self, node: ProcessNode, controller: str, joint: str, labels: Sequence[str], depth: int,
    ) -> None:
        self.state = ControllerState(controller, joint)
        self._inboxes = {
            label: Inbox(
                node, Float64, controller + topics.of_node(topics.watched(label, joint))[1:], depth
            ) for label in labels
        }

    def take(self) -> Iterator[tuple[str, int, float]]:
        """What has come: label, time of arrival [ns], value; m, c_r and c_l go to the state."""
        for label, inbox in self._inboxes.items():
            for message, info in inbox.take_all():
                if label in BACKLASH:
                    self.state.take_estimate(label, message.data)
                yield label, info['received_timestamp'], message.data


class FollowedControllers:
    """Every controller of the domain, or those of some namespaces, by name.

    wanted: names of controllers or namespaces, none for all. labels, depth: see Followed.
    Messages are taken when somebody looks: nothing wakes up for each of them.
    """

    def __init__(
        self, node: ProcessNode, wanted: Sequence[str], labels: Sequence[str], depth: int,
    ) -> None:
        self._node, self._labels, self._depth = node, labels, depth
        self._wanted = ['/' + name.strip('/') for name in wanted]
        self.by_name: dict[str, Followed] = {}
        # Those of all nodes of the domain: some robots have many.
        self._diagnostics = Inbox(node, DiagnosticArray, topics.DIAGNOSTICS, depth=100)
        node.create_timer(1.0, self._look, clock=node.steady_clock)
        self._look()

    @property
    def states(self) -> list[ControllerState]:
        """What is known of each."""
        return [followed.state for followed in self.by_name.values()]

    @property
    def awaited(self) -> str:
        """What is waited for while there is none."""
        which = ' of ' + ', '.join(self._wanted) if self._wanted else ''
        domain = self._node.context.get_domain_id()
        return (
            f'waiting for a controller{which} in ROS_DOMAIN_ID={domain}: '
            'bringup prints which one it uses'
        )

    def take_diagnostics(self) -> None:
        """Take in what has been said of the controllers."""
        for message, _ in self._diagnostics.take_all():
            for status in message.status:
                followed = self.by_name.get(f'/{status.name}')
                if followed is not None:
                    followed.state.take_diagnostics(
                        ord(status.level), status.message,
                        {pair.key: pair.value for pair in status.values},
                        time.monotonic(), time_of_day(),
                    )

    def _look(self) -> None:
        """Whoever publishes what a controller publishes is one."""
        for topic, _ in sorted(self._node.get_topic_names_and_types()):
            found = WATCHED.fullmatch(topic)
            if found and self._is_wanted(found['node']):
                controller, joint = found['node'], found['joint'] or ''
                name = f'{controller}: {joint}' if joint else controller
                if name not in self.by_name:
                    self.by_name[name] = Followed(
                        self._node, controller, joint, self._labels, self._depth
                    )

    def _is_wanted(self, name: str) -> bool:
        return not self._wanted or any(
            name == wanted or name.startswith(f'{wanted.rstrip("/")}/') for wanted in self._wanted
        )


def time_of_day() -> str:
    """Hours, minutes and seconds, for events."""
    return time.strftime('%H:%M:%S')
