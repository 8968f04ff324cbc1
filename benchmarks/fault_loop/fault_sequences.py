"""Random sequences of faults, and what must not happen in any of them."""

from collections.abc import Callable
from contextlib import suppress
from math import isfinite

import numpy as np
from cases.random_cases import NEAR_ONE
from fault_loop.fault_controller import Controller
from fault_loop.fault_world import PERIOD_S, SENSOR_FAULTS, Actuator, Driver, Sensor, parameters_of
from fault_loop.promises import PromisedBound, Uninterrupted

from backlash_ros.core.assembly import build_model, build_true_model
from backlash_ros.core.control.controller import ControlStep
from backlash_ros.core.control.limits import Limits
from backlash_ros.core.control.structure import LARGEST_F_OVER_M
from backlash_ros.core.estimate import Estimate, Status, was_given
from backlash_ros.core.parameters import ParameterError, Parameters
from backlash_ros.core.plant.transfer_function import TransferFunction

SAMPLES = (300, 800)
PAUSE = (15, 120)  # samples from one event to the next
LASTS = (5, 100)  # samples for which a fault of the sensor or the network lasts
ROUNDING = 1e-9
DEVIATIONS = 5.0  # beyond which an estimate that is said to be learned is wrong
NEGLIGIBLE = 1e-3  # of m and of the gap: an error that is none, however small the deviations
WITHOUT = 0.2  # of m and of the gap: an error of laws without deviations that is wrong
JUMP = 2.5  # usual moves of v in the first one after an interruption
LEARNED_MOVES = 50  # commands from which it is known which moves are usual


KINDS = {  # of what may be found
    'outside': 'a command outside the limits that held at that moment',
    'too_fast': 'a move beyond `control.rate_max`',
    'jumps': 'a jump at the first command after an interruption',
    'unbounded': 'u_d more than twice as far from what y_m asks for as tracking.md says',
    'broken': 'an exception',
    'failed': 'a fit without a result',
    'wrong': '*tracking* with an estimate off by more than five published deviations',
    'wrong_inherited': 'the same in a loop that began with saved estimates of another plant',
    'wrong_uncertain': 'the same where time constants of the true G differ by up to 15 %',
    'wrong_without': '*tracking* with an estimate off by a fifth, laws without deviations',
}


class Sequence:
    """One loop, and what happens to it. told: called with what happens, for a reader.

    found: what went wrong, a sentence each, by kind. claimed: whether a law with deviations has
    ever said that it has learned.
    """

    def __init__(self, seed: int, told: Callable[[str], None] = lambda text: None) -> None:
        self.rng = rng = np.random.default_rng([seed, 13])
        self.found: dict[str, list[str]] = {kind: [] for kind in KINDS}
        self.commands = self.samples = 0
        self.claimed = False
        self._told = told
        while True:
            with suppress(ParameterError):  # of a plant that is refused
                self.p, swing = parameters_of(rng)
                break
        p = self.p
        self.actuator = Actuator()
        self.driver = Driver(p, rng, self.actuator, Sensor(rng, swing), bool(rng.random() < 0.5))
        self.truth = _truth(p)
        self._foreign = False  # whether the loop began with what another plant has taught
        self._frozen: float | None = None  # y_m while the loop is interrupted
        self._since_frozen = 0
        self._stops: dict[int, Callable[[], None]] = {}  # ends of faults, by tick
        self._usual = 0.0  # largest move of v so far
        self._moves = 0
        self._v_before = 0.0  # that acted before the newest command
        self._newcomer = False  # whether the controller knows v from reports alone
        self._v_answered = self._y_m = 0.0  # of the newest answer
        self._uninterrupted: Uninterrupted | None = None  # what would follow on it
        self._last: Estimate | None = None
        self._loop: object = None
        self._lately = 'nothing yet'  # what has happened last
        self._bound = PromisedBound(p)
        inherited = None
        if rng.random() < 0.2:
            inherited, self._foreign = self._saved_elsewhere(), True
            told(f'begins with saved estimates of another plant: {inherited}')
        knows_v = rng.random() < 0.5
        self.controller = Controller(p, self.driver, inherited, self._sent, self._answered)
        if knows_v:
            self.controller.restart(inherited, 0.0)
        told(f'{p.estimator.law}, {p.structure}, truth {self.truth}')

    def run(self) -> dict[str, list[str]]:
        rng, driver = self.rng, self.driver
        self.samples = int(rng.integers(*SAMPLES))
        next_event = int(rng.integers(*PAUSE))
        for tick in range(1, self.samples + 1):
            self._stops.pop(tick, lambda: None)()
            if tick == next_event:
                self._lately = str(rng.choice(EVENTS))
                self._told(f'{tick}: {self._lately}')
                EVENTS_BY_NAME[self._lately](self, tick)
                next_event = tick + int(rng.integers(*PAUSE))
            driver.advance()
            y_m = driver.reference(tick * PERIOD_S)
            self.controller.run(y_m if self._frozen is None else self._frozen)
        self.found['unbounded'] += self._bound.exceeded()
        self._note_failed_fits()
        return self.found

    # What may happen.

    def _fail_sensor(self, tick: int) -> None:
        sensor = self.driver.sensor
        sensor.fault = str(self.rng.choice(SENSOR_FAULTS))
        sensor.value = sensor.swing * float(self.rng.uniform(-1.0, 1.0))
        self._told(f'    {sensor.fault}')
        self._lately += f': {sensor.fault}'
        self._end_later(tick, lambda: setattr(sensor, 'fault', ''))

    def _let_driver(self, fault: str, tick: int) -> None:
        setattr(self.driver, fault, True)
        self._end_later(tick, lambda: setattr(self.driver, fault, False))

    def _stall(self, tick: int) -> None:
        self.controller.stalled_until = tick + int(self.rng.integers(2, 40))

    def _restart_driver(self, tick: int) -> None:
        self.driver.down_until = tick + int(self.rng.integers(2, 80))
        self._freeze()

    def _step_clock(self, tick: int) -> None:
        self.driver.offset_ns += int(self.rng.choice([-1, 1])) * int(10 ** self.rng.uniform(6, 10))
        self._freeze()

    def _restart_controller(self, tick: int) -> None:
        self._note_failed_fits()
        rng, controller = self.rng, self.controller
        if rng.random() < 0.5:
            controller.deactivate()
        estimate: Estimate | None = controller.loop.estimate
        chance = rng.random()
        if chance < 0.4 or not estimate.learned:
            estimate, self._foreign = None, False
        elif chance < 0.6:
            estimate, self._foreign = self._saved_elsewhere(), True
        self._told(f'    with {estimate}')
        # Where the driver does not say which v acts, whoever starts the controller does.
        self._newcomer = self.driver.reports
        controller.restart(estimate, None if self._newcomer else self.actuator.v)
        self._forget()

    def _cycle(self, tick: int) -> None:
        self.controller.cycle(clean_up=bool(self.rng.integers(2)))
        self._freeze()
        if not self.controller.loop.statistics.used:
            self._forget()

    def _change_limits(self, tick: int) -> None:
        rng, p = self.rng, self.controller.p
        changes = {name: float(self.p[name]) * float(rng.uniform(0.3, 1.5))
                   for name in ('control.min', 'control.max', 'control.rate_max')
                   if isfinite(float(p[name]))}
        if changes:
            self._told(f'    {changes}')
            self.controller.take_up(p.replaced(changes))

    def _change_live(self, tick: int) -> None:
        rng, p = self.rng, self.controller.p
        scale = float(10.0 ** rng.uniform(-1.0, 1.0))
        changes: list[dict[str, object]] = [
            {'tracking.input_weight': 1e-2 * scale}, {'inverse.caution': scale},
            {'inverse.direction_band': 0.01 * scale * self.p.backlash.m},
            {'lms.step': min(scale, 1.9)}, {'inverse.take_up_rate': 100.0 * scale},
        ]
        if 'estimator.output_noise_std' in self.controller.loop.core.estimator.RETUNED:
            noise = p.output_noise_std
            changes.append({'estimator.output_noise_std': noise * scale})
        change = changes[int(rng.integers(len(changes)))]
        self._told(f'    {change}')
        self.controller.take_up(p.replaced(change))
        self._bound.take_up(self.controller.p)

    def _call_service(self, tick: int) -> None:
        loop = self.controller.loop
        kind, on = int(self.rng.integers(3)), bool(self.rng.integers(2))
        self._told(f'    {("freeze", "compensation", "reset")[kind]} {on}')
        if kind == 0:
            loop.adapt(on)
        elif kind == 1:
            loop.compensate(on)
        else:
            loop.renew(None)
            self._forget()

    def _meet_rival(self, tick: int) -> None:
        loop = self.controller.loop
        if loop.standing_down:
            return
        loop.stand_down()
        self._freeze()

        def end() -> None:
            if loop is self.controller.loop and loop.standing_down:
                limits = loop.core.limits
                low, high = max(limits.low, -1e3), min(limits.high, 1e3)
                self.actuator.v = float(self.rng.uniform(low, high))
                loop.hear_other(self.actuator.v)
                loop.resume()
                self._forget()

        self._end_later(tick, end)

    def _saved_elsewhere(self) -> Estimate:
        """What another axis with the same G has learned."""
        m, c_r, c_l = (value * float(self.rng.uniform(0.5, 2.0)) for value in self.truth)
        gap = c_r - c_l
        return Estimate(m, c_r, c_l, self.p.proportional.f, 1e-3 * m, 1e-3 * gap, 1e-3 * gap)

    # What is watched.

    def _sent(self, v: float, limits: Limits) -> None:
        before = self.actuator.v
        self._v_before = before
        if self._newcomer:
            # It cannot tell a v beyond its limits from a wrong report.
            before, self._newcomer = limits.go_on_from(before, None), False
        self.commands += 1
        where = f'sample {self.driver.tick}: v {before:.6g} -> {v:.6g}, {limits}'
        beyond, beyond_before = (max(limits.low - x, x - limits.high, 0.0) for x in (v, before))
        slack = ROUNDING * (1.0 + abs(v))
        # Limits that have been narrowed are met as fast as the rate allows.
        if not isfinite(v) or beyond > max(beyond_before - limits.move, 0.0) + slack:
            self.found['outside'].append(where)
        if not abs(v - before) <= limits.move * (1.0 + ROUNDING) + slack:
            self.found['too_fast'].append(where)

    def _answered(self, step: ControlStep, renewed: bool) -> None:
        """Judge an answer. renewed: whether nothing was known of the plant before it."""
        e, v = step.estimate, step.v
        if self._loop is not self.controller.loop:
            self._loop = self.controller.loop
            self._bound.begin(step.y)
        self._bound.note(step, renewed, self._v_before)
        move = abs(v - self._v_before)
        # Through the four blocks u_d answers at once to what y has done meanwhile.
        goes_on = renewed and self.p.structure != 'pole_placement'
        # A v that was led to zero meanwhile starts from there.
        goes_on = goes_on and self._v_before == self._v_answered
        if goes_on and self._last is not None:
            self._judge_first(step, self._last, move)
        if self.p.structure == 'proportional':
            self._uninterrupted = Uninterrupted(self.controller.loop.core)
        self._moves += 1
        self._usual = max(self._usual, move)
        self._last, self._v_answered, self._y_m = e, v, step.y_m
        if self._frozen is not None and self._moves and renewed:
            self._frozen = None
        self._judge(e)

    def _judge_first(self, step: ControlStep, before: Estimate, move: float) -> None:
        """Judge the first answer after an interruption over which v was held."""
        v, rounding = step.v, ROUNDING * (1.0 + abs(step.v))
        where = f'sample {self.driver.tick}: v moved by {move:.3g}'
        if self._uninterrupted is not None:
            loop, p = self.controller.loop, self.controller.p
            asked = self._uninterrupted.command(step, loop.core, p.inverse.direction_band)
            if abs(v - asked) > rounding:
                self.found['jumps'].append(f'{where} to {v:.6g}, uninterrupted to {asked:.6g}')
        elif self._moves >= LEARNED_MOVES and move > (
            JUMP * self._usual + _shift(before, step.estimate, v) + rounding
        ):
            self.found['jumps'].append(f'{where}, usual {self._usual:.3g}')

    def _judge(self, e: Estimate) -> None:
        if e.status is not Status.TRACKING or was_given(e):
            return
        m, c_r, c_l = self.truth
        gap = c_r - c_l
        self.claimed |= e.learned
        sizes = np.array([m, gap, gap])
        allowed = np.maximum(DEVIATIONS * np.array([e.std_m, e.std_c_r, e.std_c_l]),
                             NEGLIGIBLE * sizes) if e.learned else WITHOUT * sizes
        off = float((np.abs(np.array([e.m, e.c_r, e.c_l]) - self.truth) / allowed).max())
        if off <= 1.0:
            return
        kind = 'wrong_without' if not e.learned else 'wrong_inherited' if self._foreign \
            else 'wrong_uncertain' if self.p.truth.scale_frequency != 1.0 else 'wrong'
        self.found[kind].append(
            f'sample {self.driver.tick}, {off:.2g} times what is allowed: '
            f'm {e.m:.5g} ({m:.5g}) ± {e.std_m:.2g}, '
            f'c_r {e.c_r:.5g} ({c_r:.5g}) ± {e.std_c_r:.2g}, '
            f'c_l {e.c_l:.5g} ({c_l:.5g}) ± {e.std_c_l:.2g}; after: {self._lately}'
        )

    def _note_failed_fits(self) -> None:
        failed = self.controller.loop.core.estimator.report.failed_fits
        if failed:
            self.found['failed'].append(f'sample {self.driver.tick}: {failed} fits')

    def _freeze(self) -> None:
        """Hold y_m until the loop goes on: then v has no reason to move."""
        if self._loop is not None:
            self._frozen = self._y_m

    def _forget(self) -> None:
        """What was usual is not any more: another estimate is in use, or v was moved."""
        self._moves, self._usual, self._last, self._frozen = 0, 0.0, None, None

    def _end_later(self, tick: int, end: Callable[[], None]) -> None:
        later = tick + int(self.rng.integers(*LASTS))
        while later in self._stops:
            later += 1
        self._stops[later] = end


def _truth(p: Parameters) -> tuple[float, float, float]:
    """m, c_r, c_l as the controller may know them: the gain at rest of the true G is part of m."""
    ratio = _gain_at_rest(build_true_model(p)) / _gain_at_rest(build_model(p))
    return p.backlash.m * ratio, p.backlash.c_r, p.backlash.c_l


def _gain_at_rest(model: TransferFunction) -> float:
    """G(1), or where G integrates the gain of what is left without the integrators."""
    left = [1.0 - pole for pole in model.poles if abs(pole - 1.0) > NEAR_ONE]
    return float(np.sum(model.numerator) / np.real(np.prod(left)))


def _shift(before: Estimate, now: Estimate, v: float) -> float:
    crossings = max(abs(now.c_r - before.c_r), abs(now.c_l - before.c_l))
    reach = abs(v) + max(now.c_r, -now.c_l)
    by_f = abs(now.f - before.f) / (now.m - min(now.f, LARGEST_F_OVER_M * now.m)) * reach
    return crossings + abs(now.m - before.m) / min(now.m, before.m) * reach + by_f


EVENTS_BY_NAME: dict[str, Callable[[Sequence, int], None]] = {
    'the sensor fails': Sequence._fail_sensor,
    'outputs are lost': lambda self, tick: self._let_driver('loses', tick),
    'reports are lost': lambda self, tick: self._let_driver('loses_reports', tick),
    'outputs are repeated': lambda self, tick: self._let_driver('repeats', tick),
    'the controller is held up': Sequence._stall,
    'the driver is restarted': Sequence._restart_driver,
    'the clock is set': Sequence._step_clock,
    'the controller is restarted': Sequence._restart_controller,
    'deactivated and activated': Sequence._cycle, 'limits change': Sequence._change_limits,
    'live parameters change': Sequence._change_live, 'a service is called': Sequence._call_service,
    'a rival takes over for a while': Sequence._meet_rival,
}
EVENTS = (*EVENTS_BY_NAME, *('the sensor fails',) * 3)
