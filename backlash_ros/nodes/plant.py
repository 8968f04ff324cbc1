"""Node that simulates the plant: backlash, then G(z), then a sensor, equation (3.1)."""

import sys
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from math import inf, isfinite
from typing import Any

import numpy as np
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64

from backlash_ros import topics
from backlash_ros.core.loop.command_history import CommandHistory
from backlash_ros.core.parameters import PLANT, Parameters
from backlash_ros.core.scenario import build_plant
from backlash_ros.nodes.runtime import messages
from backlash_ros.nodes.runtime.executor import PromptExecutor
from backlash_ros.nodes.runtime.process import ProcessNode, emit, run


class PlantNode(ProcessNode):
    """Publishes y(k) and applies the newest v until y(k+1).

    Real time: every sample period; an output that is late, because the process was held up, is left
    out. Lockstep: as soon as v(k) has come; /clock tells the simulated time before every output.
    An output that is lost on purpose has no tick of /clock, so that the loss shows.
    """

    def __init__(self) -> None:
        super().__init__(PLANT)
        p = self.settings
        self._plant = build_plant(p)
        # The same draws as in a simulation in one process, so that runs agree to the last bit.
        self._loss_rng = np.random.default_rng([p.seed, 1])
        self._commands = CommandHistory(p.sample_period)  # by time of arrival, monotonic clock
        self._commands.publish(0.0, 0)
        self._expecting = False  # no v has come since the newest output
        self._published: Counter[str] = Counter()  # messages by topic, and samples
        self._applied, self._output = (
            self.create_publisher(Float64, topic, messages.DEPTH)
            for topic in (topics.APPLIED_CONTROL, topics.PLANT_OUTPUT)
        )
        if p.lockstep:
            self._clock_ticks = self.create_publisher(Clock, topics.CLOCK, messages.KEPT_QOS)
        self._truth = messages.LabelledArrayPublisher(
            self, topics.of_node(topics.TRUTH), topics.TRUTH_LABELS
        )
        self.listen(Float64, topics.CONTROL, self._on_control, 1)
        name = self.resolve_topic_name
        self.log.info(f'started: {name(topics.CONTROL)} in, {name(topics.PLANT_OUTPUT)} out, '
                      f'sample_period {p.sample_period:g} s')

    def _is_heard(self) -> bool:
        """Whether enough nodes listen; if several are wanted, one is a recorder of all topics."""
        wanted = max(self.settings.wait_for_subscribers, int(self.settings.lockstep))
        of_recorder = min(self._truth.listeners, self._applied.get_subscription_count())
        return self._output.get_subscription_count() >= wanted and of_recorder >= int(wanted > 1)

    def check_change(self, p: Parameters) -> None:
        build_plant(p)

    def take_up(self, before: Parameters) -> None:
        self._plant.change(self.settings)

    def work(self, executor: PromptExecutor) -> None:
        if self.wait_until(executor, self._is_heard, f'subscribers of {topics.PLANT_OUTPUT}'):
            emit('ready')
            if self.settings.lockstep:
                self._answer()
            else:
                self._keep_time(executor)
        super().work(executor)

    def finish(self) -> None:
        self.log.info(f'{self._plant.sample} samples')

    def _on_control(self, message: Float64, info: dict[str, Any]) -> None:
        v = message.data
        if not isfinite(v):
            return
        self._commands.publish(v, messages.arrival_ns(info['received_timestamp']))
        expected, self._expecting = self._expecting, False
        if expected and self.settings.lockstep:
            self._answer(v)

    def _answer(self, *acted: float) -> None:
        """Lockstep: advance to the next output that is not lost on purpose."""
        while not self._go_on(acted):
            acted = (self._commands.at(inf)[0],)

    def _keep_time(self, executor: PromptExecutor) -> None:
        """Real time: advance at absolute deadlines."""
        period_ns = self.settings.sample_period * 1e9
        start, tick = time.monotonic_ns(), 0
        self._go_on(())
        while not (self.stopping or self._complete):
            remaining = start + (tick + 1) * period_ns - time.monotonic_ns()
            if remaining <= 0:
                # A command that has arrived in time counts, even if it was not taken yet.
                executor.serve_urgent(0)
                # More than one if the process was held up past a deadline.
                passed = max(int((time.monotonic_ns() - start) / period_ns) - tick, 1)
                tick += passed
                due_ns = start + int(tick * period_ns)
                # v of a missed interval is that which had come by its end. Published later than
                # latest_ns, y would look like the next sample.
                self._go_on([
                    self._commands.at(due_ns - missed * period_ns if missed else inf)[0]
                    for missed in reversed(range(passed))
                ], latest_ns=due_ns + 0.75 * period_ns)
                executor.look_if_due()
            elif remaining >= 3_000_000:  # spin_once takes too long for a shorter wait
                executor.spin_once(timeout_sec=remaining * 1e-9)
            else:
                executor.serve_urgent(int(remaining))

    def _go_on(self, acted: Sequence[float], latest_ns: float = inf) -> bool:
        """Apply one v over each period that has passed and publish y, then all else.

        Returns whether y was published or the run is complete.
        """
        rows = [self._advance(v) for v in acted if not self._complete]
        finished = self._complete or self._publish_output(latest_ns)
        for row in rows:
            self._truth.publish(row)
        if self._complete:
            stepped = dict.fromkeys((topics.APPLIED_CONTROL, topics.TRUTH), self._plant.sample)
            emit('done', published={**self._published, **stepped})
        return finished

    def _advance(self, v: float) -> tuple[float, ...]:
        """Let v act over a period; returns the row of the topic TRUTH for it."""
        plant, sample = self._plant, self._plant.sample
        u, truth = plant.step(v), plant.backlash
        self._applied.publish(messages.message_with(plant.applied))
        return u, truth.m, truth.c_r, truth.c_l, v, float(sample)

    def _publish_output(self, latest_ns: float = inf) -> bool:
        """Measure y and publish it unless it is late or lost on purpose; returns whether it was."""
        sample, y, p = self._plant.sample, self._plant.measure(), self.settings
        if sample > 0 and p.output_loss > 0.0 and float(self._loss_rng.random()) < p.output_loss:
            return False
        if time.monotonic_ns() > latest_ns:
            return False
        self._expecting = True
        if p.lockstep:
            now = Time(nanoseconds=round(sample * p.sample_period * 1e9))
            self._clock_ticks.publish(Clock(clock=now.to_msg()))
        self._output.publish(messages.message_with(y))
        self._published[topics.PLANT_OUTPUT] += 1
        self._published['samples'] = sample + 1
        return True

    @property
    def _complete(self) -> bool:
        return 0 < self.settings.samples <= self._plant.sample


main = partial(run, PLANT, PlantNode)

if __name__ == '__main__':
    sys.exit(main())
