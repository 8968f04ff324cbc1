"""Parameters of reference and plant that change in a running node."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import Probe, ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant
from backlash_ros.core.parameters import Parameters


class Client:
    """Sets parameters of a node while the test listens."""

    def __init__(self, probe: Probe, node: str) -> None:
        self._probe, self._client = probe, AsyncParameterClient(probe.node, node)
        probe.wait_until(self._client.services_are_ready, f'the parameters of {node}')

    def change(self, **values: Any) -> Any:
        """The answer; __ stands for a dot."""
        future = self._client.set_parameters_atomically([
            Parameter(name.replace('__', '.'), value=value) for name, value in values.items()
        ])
        self._probe.wait_until(future.done, 'an answer')
        return future.result().result


def test_reference_changes_while_it_runs_and_a_new_frequency_makes_no_jump(
    tmp_path: Path,
) -> None:
    with ros_world(tmp_path) as world:
        reference = world.start('reference', {'frequency': 6.0})
        probe = world.probe()
        heard = probe.collect(topics.REFERENCE, Float64)
        client = Client(probe, 'reference')
        probe.wait_until(lambda: len(heard) > 30, 'the first reference')
        assert client.change(frequency=3.0).successful
        count = len(heard)
        probe.wait_until(lambda: len(heard) > count + 30, 'the slower reference')
        values = [message.data for message in heard]
        # amplitude * frequency * sample_period bounds every step of a sine without a jump.
        assert max(abs(b - a) for a, b in pairwise(values)) <= 10.0 * 6.0 * 0.01 * 1.5
        assert client.change(amplitude=2.0, bias=100.0, waveform='square').successful
        probe.wait_until(lambda: heard[-1].data in (98.0, 102.0), 'the square wave')
        refused = client.change(amplitude=-1.0)
        assert refused.reason == 'amplitude=-1.0 must be >= 0 [y_m]'
        assert not client.change(waveform='file').successful
        assert 'read-only' in client.change(sample_period=0.02).reason
        assert reference.stop() == 0


def test_plant_takes_up_another_backlash_and_goes_on_from_its_state(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        plant = world.start('plant')
        probe = world.probe()
        truth = probe.collect(topics.TRUTH, Float64MultiArray)
        client = Client(probe, 'plant')
        probe.wait_until(lambda: len(truth) > 10, 'the plant')
        assert client.change(backlash__m=2.0, backlash__c_r=1.0, output_noise_std=0.1).successful
        probe.wait_until(lambda: truth[-1].data[1:4].tolist() == [2.0, 1.0, -3.0], 'the change')
        refused = client.change(backlash__c_l=1.5)
        assert 'backlash.c_l=1.5 must be < backlash.c_r=1.0' in refused.reason
        samples = [row.data[-1] for row in truth]
        assert samples == sorted(set(samples))
        assert plant.stop() == 0


def test_changed_plant_moves_on_from_where_it_was() -> None:
    before = build_plant(Parameters())
    for k in range(50):
        before.step(0.3 * k)
    after = build_plant(Parameters({'backlash.c_l': -5.0}))
    after.go_on_from(before)
    assert after.sample == before.sample
    assert after.measure() == before.measure()
    assert after.step(14.0) == before.step(14.0)
    assert after.measure() == before.measure()
