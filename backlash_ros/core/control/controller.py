"""The adaptive controller: y_m and y to v, the way of a better G, and a motor in front of G."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isnan, nan
from typing import NamedTuple

from backlash_ros.core.control.inverse import BacklashInverse
from backlash_ros.core.control.limits import LARGEST_SIGNAL, Limits, at_rest, plausible
from backlash_ros.core.control.structure import ControlInput, ControlStructure
from backlash_ros.core.estimate import Estimate
from backlash_ros.core.estimation.settings import OUTLIERS
from backlash_ros.core.jobs import LOST, Channel, Executor, Failure
from backlash_ros.core.law import Interval, Law
from backlash_ros.core.laws.fixed import FixedBacklash
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.actuator import Actuator, Motor
from backlash_ros.core.plant.backlash import clamp
from backlash_ros.core.plant.transfer_function import StateModel

# Lost outputs in a row that are stepped over; after more nothing is left to predict from them.
LONGEST_GAP = 1000
# Samples after which a better design takes over though v crosses the gap: an unstable loop never
# stops to.
LONGEST_WAIT = 200
# Share of the motion of u that may not be what the backlash says, before and after it was learned.
DOUBT, LITTLE_DOUBT = 0.5, 0.1


class ControlStep(NamedTuple):
    """What one sample made: the command, and the estimate it was computed with."""

    y_m: float
    y: float
    u_d: float
    v: float
    estimate: Estimate


class AdaptiveController:
    """Learns the backlash from v and y and publishes v = BI(u_d), section 3 of the paper.

    Call `step` once per received y, and `refine` when v is on its way. compensating: False inverts
    the slope alone. motion: of the newest command. redesign: whether the structure is designed anew
    for the better models of G that the estimator proposes, by the executor. serial: the motor and G
    as the structure sees them; None where v is what it commands.
    """

    def __init__(
        self, estimator: Law, structure: ControlStructure, inverse: BacklashInverse,
        limits: Limits, redesign: bool = False, serial: SerialPlant | None = None,
        executor: Executor | None = None,
    ) -> None:
        self.estimator, self.structure = estimator, structure
        self.inverse, self.limits = inverse, limits
        self.motion = at_rest(inverse.v)
        self.compensating, self.lost_samples = True, 0
        self.redesign = Redesign((executor or Executor()).open()) if redesign else None
        self._serial = serial
        self._led: tuple[float, float, float] | None = None  # newest v, y_m and u_d led to it

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
        alternatives: Sequence[float] = (), commands: Sequence[float] = (),
    ) -> ControlStep:
        """Learn from y(k), and return the command for sample k, within the limits.

        lost: samples that never arrived since the last call. Of each of the lost + 1 intervals,
        if it is known: applied, the v that was; commands, those that acted if not the last one;
        alternatives, those that may have acted instead, nan where none may.
        """
        if not (plausible(y) and plausible(y_m) and all(map(plausible, (*applied, *commands)))):
            raise ValueError(
                f'y={y!r}, y_m={y_m!r}, applied={applied!r} and commands={commands!r} must be '
                f'finite and no larger than {LARGEST_SIGNAL:g}')
        serial, inverse = self._serial, self.inverse
        if self._led is not None:
            sent, y_m_before, u_d_before = self._led
            self.lost_samples += lost
            for i in range(lost + 1):
                heard, other = y if i == lost else None, nan
                command = commands[i] if commands else sent
                v = applied[i] if applied else None
                if serial is not None:
                    v = serial.update(heard, command, v, self.estimator.estimate)
                elif v is None:
                    v, other = command, alternatives[i] if alternatives else nan
                self.estimator.update(heard, Interval(v, y_m_before, u_d_before, other))
        used = estimate = self.estimator.estimate
        if not self.compensating:
            used = replace(estimate, c_r=0.0, c_l=0.0)
        elif serial is not None:
            used = serial.for_command(estimate)
        inputs = ControlInput(y_m, y, used, self._source, self.limits)
        u_d = self.structure.control(inputs, inverse)
        self.motion = self.limits.apply(inverse.v, self.motion)
        v = self.motion.v
        inverse.applied(v)
        self._led = v, y_m, u_d
        return ControlStep(y_m, y, u_d, v, estimate)

    def refine(self) -> None:
        """Do what the command did not have to wait for; who has no time for it leaves it out."""
        self.structure.prepare()
        self.estimator.refine()
        if self.redesign is not None:
            gains = self.redesign.due(self.estimator.proposal, self.structure, self._serial)
            if gains is not None:
                # At once and together: x_hat and gains of two models do not fit each other.
                self._adopt(self.redesign.considered)
                self.structure.adopt(gains, self._source)

    def command_of(self, v: float) -> float:
        """The command at which the motor rests at a v that was reported."""
        return v if self._serial is None else v / self._serial.actuator.gain

    def start_from(self, v: float) -> None:
        """Say which command acts now, so that the first one goes on from there."""
        if v != self.motion.v:
            self.motion = at_rest(v)
        self.inverse.start_from(v)

    def go_on_from(self, before: AdaptiveController) -> None:
        """Go on where `before` ends, with v and the learned G; the state got unknown."""
        self.inverse, self.motion, self.structure = before.inverse, before.motion, before.structure
        if self.redesign is not None and before.redesign is not None:
            self.redesign.considered = before.redesign.considered
            self._adopt(before.redesign.adopted)
        self.structure.restart()

    def retune(self, p: Parameters) -> None:
        """Take up new values of parameters of law and structure; what was learned stays."""
        self.estimator.retune(p)
        self.structure.retune(p, self._source)

    def close(self) -> None:
        """Give back what estimator and designs hold elsewhere."""
        self.estimator.close()
        if self.redesign is not None:
            self.redesign.channel.close()

    def _adopt(self, model: StateModel | None) -> None:
        if self.redesign is not None and model is not None:
            self.redesign.adopted = model
            self.estimator.adopt(model)
            if self._serial is not None:
                self._serial.adopt(self._serial.before(model))

    @property
    def _source(self) -> Law:
        """What knows the state of the plant of v."""
        return self.estimator if self._serial is None else self._serial.observer


@dataclass
class Redesign:
    """Has gains made for the better models of G that the estimator proposes, one at a time."""

    channel: Channel  # where they are made
    adopted: StateModel | None = None  # the learned G that is in use
    considered: StateModel | None = None  # the proposal that was designed for last
    failed: int = 0  # designs without a result
    _gains: object | None = None  # that are made and could not take over yet
    _waited: int = 0  # samples for which they could not

    def due(
        self, proposal: StateModel | None, structure: ControlStructure, serial: SerialPlant | None,
    ) -> object | None:
        """Gains for `considered` that take over now, None for none. proposal: the newest G."""
        if proposal is not None and proposal is not self.considered and not self.channel.busy:
            self.considered, self._gains, self._waited = proposal, None, 0
            model = proposal if serial is None else serial.before(proposal)
            job = structure.redesign(model)
            if job is None:
                self._gains = ()  # the better G alone takes over
            else:
                self.channel.submit(job)
        found = self.channel.poll()
        if isinstance(found, Failure):
            if found.kind == LOST:
                self.considered = None  # the same again, by another worker
            else:
                self.failed += 1
        elif found is not None:
            self._gains = found
        if self._gains is None:
            return None
        self._waited += 1
        if not structure.may_change and self._waited <= LONGEST_WAIT:
            return None
        gains, self._gains = self._gains, None
        return gains


class SerialPlant:
    """A motor with its position loop L(z), and G behind it, as one plant of the command.

    Where v is the position of a motor encoder, the estimator learns G from that; the structure
    however commands the motor, and y answers as L(z) G(z) does. The gap and L change places in it,
    as L takes less time than a motion: it inverts the gap with the wind-up of the motor added.
    """

    def __init__(self, actuator: Actuator, model: StateModel, noise_std: float) -> None:
        self.actuator, self._noise_std, self._motor = actuator, noise_std, Motor(actuator)
        # What the gap holds, in units of v and of the command: its middle where it begins.
        self._play = self._commanded = nan
        self._learned = False
        # u and y, from which a new observer finds the state.
        self._newest: deque[tuple[float, float | None]] = deque(maxlen=60)
        self.adopt(self.before(model))

    def before(self, model: StateModel) -> StateModel:
        """L G for a G."""
        return StateModel(self.actuator.in_front_of(model.transfer_function))

    def adopt(self, model: StateModel) -> None:
        """Give x_hat for this L G from now on."""
        self._model = model
        # It is told u: to the observer there is no backlash.
        self.observer = FixedBacklash(Estimate(1.0, 0.0, 0.0, 0.0), model, self._noise_std,
                                       LITTLE_DOUBT if self._learned else DOUBT)
        self._variance, self._taken, self._refused = 0.0, 0, 0
        for u, y in self._newest:
            self._follow(y, u)

    def for_command(self, estimate: Estimate) -> Estimate:
        """The estimate with its crossings as the command meets them."""
        c_r, c_l = self.actuator.crossings(estimate.c_r, estimate.c_l)
        return replace(estimate, c_r=c_r, c_l=c_l)

    def update(
        self, y: float | None, command: float, applied: float | None, estimate: Estimate,
    ) -> float:
        """Take in y(k), None if lost, and the command of the interval before it; return its v."""
        c_r, c_l, gap = estimate.c_r, estimate.c_l, estimate.c_r - estimate.c_l
        play = command * self.actuator.gain + c_r if isnan(self._play) else self._play
        position = self._motor.step(command, play - c_r, c_r, c_l)
        v = position if applied is None else applied  # as it was reported
        self._play = clamp(v + 0.5 * gap if isnan(self._play) else self._play, v, v + gap)
        # Nothing is known of the gap before it was learned.
        seen = self.for_command(
            estimate if estimate.learned else replace(estimate, c_r=0.0, c_l=0.0))
        gap = seen.c_r - seen.c_l
        held = command + 0.5 * gap if isnan(self._commanded) else self._commanded
        self._commanded = clamp(held, command, command + gap)
        if estimate.learned is not self._learned:
            self._learned = estimate.learned
            self.adopt(self._model)
        u = seen.m * (self._commanded - seen.c_r)
        self._newest.append((u, y))
        self._follow(y, u)
        return v

    def _follow(self, y: float | None, u: float) -> None:
        averaged = 100  # innovations, of whose rms y may differ: they come in bursts at crossings
        observer = self.observer
        if y is not None and self._taken >= averaged:
            least = max(self._variance, self._noise_std**2)
            # So many outliers in a row are none.
            if (y - observer.predicted(u)) ** 2 > 100.0**2 * least and self._refused < OUTLIERS:
                self._refused += 1
                y = None
        observer.update(y, Interval(u, nan, nan))
        if y is not None:
            self._refused = 0
            self._taken += 1
            change = observer.innovation**2 - self._variance
            self._variance += change / min(self._taken, averaged)
