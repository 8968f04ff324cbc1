"""Random messages, calls and parameters for the controller node: nothing may break it.

    python test/fuzzing.py --sequences 100000

Every sequence meets a freshly configured controller through the callbacks of the real node.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from math import inf, isfinite
from typing import Any

import numpy as np
from node_in_process import catch_commands, hand_over, look_for_silence, node_with
from rclpy.parameter import Parameter

from backlash_ros.core.assembly import law_fits
from backlash_ros.core.loop.sample_counter import UNNUMBERED, Output
from backlash_ros.nodes.controller import ControllerNode
from backlash_ros.tools.bringup.environment import free_domain

PERIOD_S, PERIOD_NS = 1e-3, 1_000_000
LOW, HIGH = -20.0, 30.0
ODD = (
    float('nan'), inf, -inf, 1e300, -1e300, 5e-324, -5e-324, 0.0, -0.0, 1e12, -1e12, 1e-12, 3.0,
)
LAWS = ('moving_horizon', 'moving_horizon', 'lms', 'printed', 'fixed', 'gradient')
STRUCTURES = ('proportional', 'tracking', 'pole_placement')
EVENTS_PER_SEQUENCE = 40
SEQUENCES_PER_NODE = 200


def parameters_of(rng: np.random.Generator) -> dict[str, object]:
    """Values for a node."""
    law = str(rng.choice(LAWS))
    structure = str(rng.choice([name for name in STRUCTURES if law_fits(law, name)]))
    return {
        'sample_period': PERIOD_S, 'estimator.law': law, 'structure': structure,
        'control.min': LOW, 'control.max': HIGH,
        'control.rate_max': float(rng.choice([inf, 2e3, 5e4])),
        'estimator.output_noise_std': float(rng.choice([0.0, 1e-9, 1e-3, 1.0])),
        'inverse.direction_band': float(rng.choice([0.0, 0.1])),
        'inverse.take_up_rate': float(rng.choice([inf, 1e3])),
        'control.delay_samples': int(rng.integers(0, 3)),
        'estimator.use_applied_control': str(rng.choice(['auto', 'true', 'false'])),
        'timeout.plant_output': float(rng.choice([0.0, 0.01, 0.5])),
        'autostart': False,
    }


class Fuzzer:
    """Plays one random driver, reference and user after the other."""

    def __init__(self, node: ControllerNode, rng: np.random.Generator, move: float) -> None:
        self._node, self._rng, self._move = node, rng, move
        self._untyped: Any = node
        self._stamp, self._number, self._y = 10**18, 0, 0.0
        self._sent: list[float] = []
        self.commands = 0  # that were checked
        catch_commands(node, self._sent.append)

    def play(self) -> None:
        """One sequence; raises AssertionError for a command that must not be."""
        node, rng = self._node, self._rng
        self._untyped.trigger_configure()
        self._untyped.trigger_activate()
        (loop,) = node.configured
        self._number = 0
        # Some drivers are sound most of the time: only then is there anything to learn.
        soundness = float(rng.choice([0.3, 0.9, 0.98]))
        before = loop.v
        for _ in range(EVENTS_PER_SEQUENCE):
            self._sent.clear()
            self._event(soundness)
            for v in self._sent:
                assert isfinite(v), v
                assert LOW <= v <= HIGH, v
                assert abs(v - before) <= self._move * (1.0 + 1e-9), (v, before)
                before = v
                self.commands += 1
        self._untyped.trigger_deactivate()
        assert LOW <= loop.v <= HIGH
        self._untyped.trigger_cleanup()

    def _event(self, soundness: float) -> None:
        """Let something happen."""
        node, rng = self._node, self._rng
        (loop,) = node.configured
        if rng.random() < soundness:
            self._output(self._sound_y(), PERIOD_NS, 1)
            hand_over(node, float(5.0 * np.sin(0.1 * self._number)), None)
            return
        kind = int(rng.integers(9))
        if kind == 0:
            self._output(self._number_of_any_kind(), PERIOD_NS, 1)
        elif kind == 1:
            hand_over(node, self._number_of_any_kind(), None)
        elif kind == 2:
            # Where a command must not move further than the rate allows, the driver is honest
            # about v: whoever restarts goes on from what it says.
            honest = isfinite(self._move)
            loop.take_applied(loop.v if honest else self._number_of_any_kind(), self._stamp)
        elif kind == 3:
            jump = int(rng.choice([-10**15, -5 * PERIOD_NS, 0, 1, 50 * PERIOD_NS, 10**15]))
            self._output(self._sound_y(), jump, int(rng.choice([-1000, 0, 1, 2, 1000])))
        elif kind == 4:
            for _ in range(int(rng.integers(1, 20))):
                self._output(self._sound_y(), PERIOD_NS // 20, 1)
        elif kind == 5:
            loop.adapt(bool(rng.integers(2)))
            loop.compensate(bool(rng.integers(2)))
        elif kind == 6:
            loop.renew(None if rng.integers(2) else loop.estimate)
        elif kind == 7:
            noise = [Parameter('estimator.output_noise_std', value=self._size())]
            node.set_parameters_atomically([
                *(noise if 'estimator.output_noise_std' in loop.core.estimator.RETUNED else []),
                Parameter('tracking.input_weight', value=self._size() + 1e-9),
                Parameter('inverse.direction_band', value=self._size()),
            ])
        else:
            self._silence()

    def _silence(self) -> None:
        look_for_silence(self._node)
        self._untyped._diagnose()

    def _output(self, y: float, later_ns: int, numbers: int) -> None:
        self._stamp = max(self._stamp + later_ns, 1)
        self._number = max(self._number + numbers, 0)
        number = UNNUMBERED if self._stamp % 7 == 0 else self._number
        hand_over(self._node, None, Output(
            y, self._stamp, time.time_ns(), time.time_ns(), number
        ))

    def _sound_y(self) -> float:
        self._y = 0.95 * self._y + float(self._rng.normal())
        return self._y

    def _size(self) -> float:
        return float(abs(self._rng.normal()) * 10.0 ** self._rng.integers(-9, 1))

    def _number_of_any_kind(self) -> float:
        rng = self._rng
        if rng.random() < 0.5:
            return float(rng.choice(ODD))
        return float(np.frombuffer(rng.bytes(8), dtype=np.float64)[0])


def fuzz(seed: int, sequences: int) -> int:
    """Play so many sequences with one node; returns the number of commands that were checked."""
    rng = np.random.default_rng(seed)
    values = parameters_of(rng)
    rate = values['control.rate_max']
    assert isinstance(rate, float)
    # A loop that restarts goes on from the v that the driver says it applies.
    move = rate * PERIOD_S if values['estimator.use_applied_control'] == 'false' else inf
    with free_domain() as domain, node_with(values, domain) as node:
        fuzzer = Fuzzer(node, rng, move)
        for i in range(sequences):
            try:
                fuzzer.play()
            except Exception:
                print(f'seed {seed}, sequence {i}: {values}', file=sys.stderr)
                raise
    return fuzzer.commands


def _fuzz(task: tuple[int, int]) -> int:
    fuzz(*task)
    return task[1]


def main() -> int:
    """Fuzz in as many processes as there are processors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--sequences', type=int, default=10_000)
    parser.add_argument('--first-seed', type=int, default=1)
    options = parser.parse_args()
    nodes = -(-options.sequences // SEQUENCES_PER_NODE)
    tasks = [(options.first_seed + i, SEQUENCES_PER_NODE) for i in range(nodes)]
    done = 0
    # A node must not be forked.
    with multiprocessing.get_context('spawn').Pool(maxtasksperchild=20) as pool:
        for count in pool.imap_unordered(_fuzz, tasks):
            done += count
            print(f'\r{done} sequences', end='', flush=True)
    print(': no exception, every command finite and within the limits')
    return 0


if __name__ == '__main__':
    sys.exit(main())
