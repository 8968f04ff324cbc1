"""What is promised of commands: how far u_d may go, and that v goes on after an interruption."""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from itertools import chain, product
from math import inf

import numpy as np

from backlash_ros.core import Parameters, Status, build_controller, build_plant
from backlash_ros.core.assembly import build_model, build_state_model
from backlash_ros.core.control.controller import AdaptiveController, ControlStep
from backlash_ros.core.control.limits import at_rest
from backlash_ros.core.control.structure import (
    LARGEST_F_OVER_M,
    LARGEST_FEEDBACK,
    LARGEST_IN_ACQUISITION,
    ControlInput,
)
from backlash_ros.core.control.tracking.design import feedback_around
from backlash_ros.core.control.tracking.feedback import TOLERANCE
from backlash_ros.core.control.tracking.tracking import FADING

ROUNDING = 1e-9
TWICE = 2.0  # an interruption may ask for what the reference alone does not


class PromisedBound:
    """Hears of every answer, and compares u_d with what the references ask for.

    That is what a loop with the same G but no gap makes of them.
    """

    def __init__(self, p: Parameters) -> None:
        self._p, self._structure = p, p.structure
        self._weights = {p.tracking.input_weight}  # with which u_d was asked for
        self._noise = p.estimator.output_noise_std  # largest that was told
        # Largest |u_d| while nothing was known, and after: beyond what was handed over.
        self._u_d = {False: 0.0, True: 0.0}
        self._handed_over = 0.0  # of the v with which the loop went on: its share of u_d, or |v|
        self._widest = 0.0  # u that the gap takes
        self._segments: list[tuple[float, list[float]]] = []  # y and y_m of each new loop

    def begin(self, y: float) -> None:
        self._segments.append((y, []))

    def take_up(self, p: Parameters) -> None:
        self._weights.add(p.tracking.input_weight)
        self._noise = max(self._noise, p.estimator.output_noise_std)

    def note(self, step: ControlStep, renewed: bool, v_before: float) -> None:
        """Take in an answer.

        renewed: whether nothing was known of the plant before it. v_before: acted until then.
        """
        e, f = step.estimate, step.estimate.f
        self._segments[-1][1].append(step.y_m)
        self._widest = max(self._widest, e.m * (e.c_r - e.c_l))
        beyond = 0.0
        if self._structure == 'proportional':
            # (3.2) takes v as it is, until it has come to its line; it never goes further out.
            if renewed:
                self._handed_over = abs(v_before)
            if abs(step.u_d - step.y_m) <= abs(f) * self._handed_over * (1.0 + ROUNDING):
                beyond = abs(step.u_d)
            self._handed_over = min(self._handed_over, abs(step.v))
        elif self._structure == 'tracking':
            self._handed_over *= FADING
            if renewed:
                self._handed_over = e.m * (abs(v_before) + max(e.c_r, -e.c_l))
            beyond = self._handed_over
        known = e.learned or e.status is Status.TRACKING
        self._u_d[known] = max(self._u_d[known], abs(step.u_d) - beyond)

    def exceeded(self) -> Iterator[str]:
        """What u_d has reached, where that is more than is promised."""
        for known, u_d in self._u_d.items():
            # The gapless loop is only run where it may matter.
            if not u_d <= self._allowed(known, self._widest):
                allowed = self._allowed(known, max(self._asked(), self._widest))
                if not u_d <= allowed:
                    yield f'u_d reached {u_d:.3g}, allowed {allowed:.3g}'

    def _allowed(self, known: bool, asked: float) -> float:
        """Largest u_d. known: whether something was. asked: by the references, or the gap."""
        p = self._p
        if self._structure == 'proportional':
            f = max(abs(p.proportional.f), *map(abs, p.proportional.bounds))
            bounds = (getattr(p.estimator.bounds, name) for name in ('c_r', 'c_l'))
            c = max(map(abs, chain(*bounds)))
            return (p.amplitude + f * c) / (1.0 - LARGEST_F_OVER_M)
        if not known:
            return TWICE * (1.0 + LARGEST_IN_ACQUISITION) * asked
        return TWICE * (asked + LARGEST_FEEDBACK * max(asked, self._called_for()))

    def _called_for(self) -> float:
        """What full feedback in `tracking` makes of errors of y that would not matter at rest."""
        if self._structure != 'tracking':
            return 0.0
        model, t = build_state_model(self._p), self._p.tracking
        gains = (feedback_around(model, t._replace(input_weight=weight), 1.0).state
                 for weight in self._weights)
        return TOLERANCE * self._noise * max(float(np.linalg.norm(gain)) for gain in gains)

    def _asked(self) -> float:
        """Largest |u_d| of a loop that knows a plant without a gap, for the same references."""
        known = self._p.replaced({
            'estimator.law': 'fixed', 'estimator.initial.m': self._p.backlash.m,
            'estimator.initial.c_r': 0.0, 'estimator.initial.c_l': 0.0,
            'backlash.c_r': 1e-9, 'backlash.c_l': -1e-9, 'output_noise_std': 0.0,
            'control.min': -inf, 'control.max': inf, 'control.rate_max': inf,
            'on_stop': 'hold', 'on_timeout': 'hold', 'inverse.take_up_rate': inf,
            'truth.scale_frequency': 1.0,
        })
        largest = 0.0
        # tracking begins at the first y, the four blocks at 0.
        starts = ((begin, references) for y, references in self._segments for begin in (y, 0.0))
        model = build_model(self._p)
        for (begin, references), weight in product(starts, sorted(self._weights)):
            p = known.replaced({'tracking.input_weight': weight})
            # u that holds y where it begins: from there on the loop is that which begins at 0.
            held = begin * float(model.denominator.sum() / model.numerator.sum())
            largest = max(largest, abs(held))
            core, plant = build_controller(p), build_plant(p)
            for y_m in references:
                step = core.step(plant.measure(), y_m - begin)
                plant.step(step.v)
                largest = max(largest, abs(step.u_d + held))
        return largest


class Uninterrupted:
    """Inverse and structure of a core as they are now, to go on with what will be asked of it.

    y and what is known of G do not matter to (3.2). So v, which was held, has to go on from an
    interruption to the last bit as if there had been none.
    """

    def __init__(self, core: AdaptiveController) -> None:
        self._inverse, self._structure = copy(core.inverse), copy(core.structure)

    def command(self, step: ControlStep, core: AdaptiveController, band: float) -> float:
        """v instead of that of the step. core: for what may be set meanwhile, as band, too."""
        inverse, v_before = self._inverse, self._inverse.v
        inverse.take_up = core.inverse.take_up
        inverse.direction_band = band
        used = step.estimate if core.compensating else replace(step.estimate, c_r=0.0, c_l=0.0)
        inputs = ControlInput(step.y_m, step.y, used, core.estimator)
        self._structure.control(inputs, inverse)
        return core.limits.apply(inverse.v, at_rest(v_before)).v
