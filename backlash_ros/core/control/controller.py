"""The adaptive controller: makes v from y_m and y, redesigns for a better G, allows for a motor."""

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

# Longest run of lost outputs that prediction bridges; after a longer one the loop begins anew.
LONGEST_GAP = 1000
# Samples after which a better design takes over even while v crosses the gap: in an unstable loop
# it never stops crossing.
LONGEST_WAIT = 200
# Disturbance of u per sample as a fraction of the motion of u, before and after the gap is learned.
DOUBT, LITTLE_DOUBT = 0.5, 0.1


class ControlStep(NamedTuple):
    """Result of one sample: the command v, and the inputs and the estimate it was computed from."""

    y_m: float
    y: float
    u_d: float
    v: float
    estimate: Estimate


class AdaptiveController:
    """Learns the backlash from v and y and computes v = BI(u_d), section 3 of the paper.

    Call `step` once per received y, and `refine` after v has been sent. compensating: if False, the
    inverse uses the slope only. motion: of the newest command. redesign: whether the executor
    designs new gains for each better G that the estimator proposes. serial: motor and G as one
    plant of the command; None if the command itself is v.
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
        self._newest: tuple[float, float, float] | None = None  # the newest v, y_m and u_d

    def step(
        self, y: float, y_m: float, lost: int = 0, applied: Sequence[float] = (),
        alternatives: Sequence[float] = (), commands: Sequence[float] = (),
    ) -> ControlStep:
        """Learn from y(k), and return the command for sample k, within the limits.

        lost: samples that never arrived since the last call. The sequences have one value for each
        of the lost + 1 intervals, or are empty: applied, the v that was reported; commands, the
        command that acted (default: the last one); alternatives, another that may have, or nan.
        """
        if not (plausible(y) and plausible(y_m) and all(map(plausible, (*applied, *commands)))):
            raise ValueError(
                f'y={y!r}, y_m={y_m!r}, applied={applied!r} and commands={commands!r} must be '
                f'finite and no larger than {LARGEST_SIGNAL:g}')
        serial, inverse = self._serial, self.inverse
        if self.redesign is not None:
            self.redesign.waited += 1
        if self._newest is not None:
            sent, y_m_before, u_d_before = self._newest
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
        self._newest = v, y_m, u_d
        return ControlStep(y_m, y, u_d, v, estimate)

    def prepare(self) -> None:
        """Do the work for the next sample that the command of this one need not wait for."""
        self.structure.prepare()
        self.estimator.prepare()
        if self._serial is not None:
            self._serial.observer.prepare()

    def refine(self) -> None:
        """Do work that the command need not wait for: adopt a better G or refine the estimates.

        May be left out if time is short.
        """
        self.prepare()
        redesign = self.redesign
        gains = None if redesign is None else redesign.due(
            self.estimator.proposal, self.structure, self._serial)
        if redesign is None or gains is None:
            self.estimator.refine()
        else:
            # Both within one sample: x_hat of one model does not fit the gains of another.
            self._adopt(redesign.considered)
            self.structure.adopt(gains, self._source)

    def command_of(self, v: float) -> float:
        """The command that holds the motor at rest at the reported v."""
        return v if self._serial is None else v / self._serial.actuator.gain

    def start_from(self, v: float) -> None:
        """Set the command that acts now, from which the first command continues."""
        if v != self.motion.v:
            self.motion = at_rest(v)
        self.inverse.start_from(v)

    def go_on_from(self, before: AdaptiveController) -> None:
        """Take over v, structure and learned G from `before`; the plant state becomes unknown."""
        self.inverse, self.motion, self.structure = before.inverse, before.motion, before.structure
        if self.redesign is not None and before.redesign is not None:
            self.redesign.considered = before.redesign.considered
            self._adopt(before.redesign.adopted)
        self.structure.restart()

    def retune(self, p: Parameters) -> None:
        """Apply new values of the live parameters of law and structure; keep what was learned."""
        self.estimator.retune(p)
        if self.structure.retune(p, self._source) and self.redesign is not None:
            self.redesign.restart()

    def close(self) -> None:
        """Release what the estimator and the redesign hold in the executor."""
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
        """The law or observer that estimates the state of the plant which the command drives."""
        return self.estimator if self._serial is None else self._serial.observer


@dataclass
class Redesign:
    """Designs gains for each better G that the estimator proposes, one at a time."""

    channel: Channel  # computes the designs
    adopted: StateModel | None = None  # the learned G in use
    considered: StateModel | None = None  # the newest proposal that a design was begun for
    failed: int = 0  # designs that failed
    waited: int = 0  # samples since gains first waited to take over, or since a design began
    _gains: object | None = None  # finished gains that wait to take over
    _outdated: bool = False  # whether the design under way is

    def restart(self) -> None:
        """Design anew what has not taken over yet."""
        self.considered, self._gains, self._outdated = None, None, self.channel.busy

    def due(
        self, proposal: StateModel | None, structure: ControlStructure, serial: SerialPlant | None,
    ) -> object | None:
        """Return gains for `considered` if they may take over now, else None. proposal: a new G."""
        if proposal is not None and proposal is not self.considered and not self.channel.busy:
            # A newer design does not begin to wait once more.
            self.waited = 0 if self._gains is None else self.waited
            self.considered, self._gains = proposal, None
            model = proposal if serial is None else serial.before(proposal)
            job = structure.redesign(model)
            if job is None:
                self._gains = ()  # no gains to design: only the better G takes over
            else:
                self.channel.submit(job)
        found = self.channel.poll()
        if found is not None and self._outdated:
            self._outdated, found = False, None
        if isinstance(found, Failure):
            if found.kind == LOST:
                self.considered = None  # the worker died: try the same proposal again
            else:
                self.failed += 1
        elif found is not None:
            self._gains = found
        if self._gains is None or (not structure.may_change and self.waited <= LONGEST_WAIT):
            return None
        gains, self._gains = self._gains, None
        return gains


class SerialPlant:
    """A motor with its position loop L(z), and G behind it, as one plant from command to y.

    Where v is measured by a motor encoder, the estimator learns G from that v, but the structure
    commands the motor, and y responds as L(z) G(z). As L is fast beside any motion, the gap is
    modelled in front of L: the inverse uses crossings widened by the wind-up of the motor.
    """

    def __init__(self, actuator: Actuator, model: StateModel, noise_std: float) -> None:
        self.actuator, self._noise_std, self._motor = actuator, noise_std, Motor(actuator)
        # Play outputs p behind v and behind the command; nan until they start in mid-gap.
        self._play = self._commanded = nan
        self._learned = False
        # Newest (u, y), from which a new observer recovers the state.
        self._newest: deque[tuple[float, float | None]] = deque(maxlen=60)
        self.adopt(self.before(model))

    def before(self, model: StateModel) -> StateModel:
        """Return L(z) G(z) for this model of G."""
        return StateModel(self.actuator.in_front_of(model.transfer_function))

    def adopt(self, model: StateModel) -> None:
        """Estimate the state of this model of L(z) G(z) from now on."""
        self._model = model
        # The observer is given u, so it needs no backlash of its own.
        self.observer = FixedBacklash(Estimate(1.0, 0.0, 0.0, 0.0), model, self._noise_std,
                                       LITTLE_DOUBT if self._learned else DOUBT)
        self._variance, self._taken, self._refused = 0.0, 0, 0
        for u, y in self._newest:
            self._follow(y, u)

    def for_command(self, estimate: Estimate) -> Estimate:
        """Return the estimate with the crossings converted from v to the command."""
        c_r, c_l = self.actuator.crossings(estimate.c_r, estimate.c_l)
        return replace(estimate, c_r=c_r, c_l=c_l)

    def update(
        self, y: float | None, command: float, applied: float | None, estimate: Estimate,
    ) -> float:
        """Take in y(k) (None if lost) and the command before it; return the v of that interval."""
        c_r, c_l, gap = estimate.c_r, estimate.c_l, estimate.c_r - estimate.c_l
        play = command * self.actuator.gain + c_r if isnan(self._play) else self._play
        position = self._motor.step(command, play - c_r, c_r, c_l)
        v = position if applied is None else applied  # the reported v, if there is one
        self._play = clamp(v + 0.5 * gap if isnan(self._play) else self._play, v, v + gap)
        # Before the gap is learned, assume none.
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
        averaged = 100  # innovations in the variance that outliers are judged by: bursts at turns
        observer = self.observer
        if y is not None and self._taken >= averaged:
            least = max(self._variance, self._noise_std**2)
            # OUTLIERS rejected in a row cannot be outliers: the model is off.
            if (y - observer.predicted(u)) ** 2 > 100.0**2 * least and self._refused < OUTLIERS:
                self._refused += 1
                y = None
        observer.update(y, Interval(u, nan, nan))
        if y is not None:
            self._refused = 0
            self._taken += 1
            change = observer.innovation**2 - self._variance
            self._variance += change / min(self._taken, averaged)
