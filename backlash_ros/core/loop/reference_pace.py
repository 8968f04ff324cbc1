"""When y_m leaves, and for which sample: paced by plant_output, by the own clock without it."""

from math import inf

from backlash_ros.core.loop.sample_counter import JITTER


class ReferencePace:
    """Says at any time which sample of y_m is to leave now, if any; times are on a steady clock
    [s].

    y_m(k+1) leaves half a period after y(k) was due, or as soon as a late y(k) is there; without
    outputs it goes on by the own clock. At most one leaves per period, and none for the same sample
    twice once the first output has come. waits: y_m(0) is repeated until then. own_clock: False on
    simulated time, which may run at any speed: the newest y_m is repeated.
    """

    def __init__(self, period_s: float, waits: bool, now_s: float, own_clock: bool = True) -> None:
        self.waits, self._period_s, self._own_clock = waits, period_s, own_clock
        self._fresh = False  # an output that is not answered yet
        self._heard_s = -inf  # when the newest output came
        self._offset = 0  # sample of y_m that follows the newest output, less its index
        self._next = 0  # sample that follows the newest output
        self._sent = -1
        self._due_s = now_s

    def hear(self, index: int, at_s: float) -> None:
        if self._heard_s == -inf:
            self._offset = 1 if self.waits else self._next - index
        # Where the own clock has run ahead, y_m does not go back.
        self._offset = max(self._offset, self._sent - index)
        self._next = index + self._offset
        self._fresh, self._heard_s, self.waits = True, at_s, False

    def listens(self, now_s: float) -> bool:
        """Whether it is time to look for an output, and to wait for one if none is there."""
        return now_s >= self._due_s

    def look_s(self, now_s: float) -> float:
        """When there is something to do at the latest."""
        return self._due_s if now_s < self._due_s else self._give_up_s

    def sample_to_send(self, now_s: float) -> int | None:
        """The sample whose y_m has to leave now; None where it is not time yet."""
        period, sample = self._period_s, self._next
        if now_s < self._due_s:
            return None
        if self._heard_s == -inf:
            # Messages that were due while the process was held up are not made up for.
            self._due_s = max(self._due_s, now_s - 0.5 * period) + period
            self._next += not self.waits
            self._sent = sample
            return sample
        if self._fresh:
            self._fresh = False
            self._due_s = self._heard_s + 1.5 * period
        elif now_s < self._give_up_s:
            return None
        elif not self._own_clock:
            self._due_s = now_s + period
            return sample
        else:
            missing = max(int((now_s - self._heard_s) / period - JITTER), 1)
            self._due_s = self._heard_s + (1 + missing + JITTER) * period
            sample += missing
        if sample <= self._sent:
            return None
        self._sent, self._due_s = sample, max(self._due_s, now_s + 0.5 * period)
        return sample

    @property
    def _give_up_s(self) -> float:
        # When an output that has not come yet counts as lost.
        return max(self._due_s, self._heard_s + (1.0 + JITTER) * self._period_s)
