"""Parameters of reference and plant that change in a running node."""

from __future__ import annotations

from array import array
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import Probe, ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.assembly import build_plant
from backlash_ros.core.parameters import Parameters
from backlash_ros.core.parameters.table import PARAMETERS


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


def dumped(probe: Probe, node: str) -> dict[str, Any]:
    """Name and value of every parameter, as `ros2 param dump` asks for them."""
    client = AsyncParameterClient(probe.node, node)
    probe.wait_until(client.services_are_ready, f'the parameters of {node}')
    listed = client.list_parameters()
    probe.wait_until(listed.done, 'the names')
    names = sorted(listed.result().result.names)
    answer = client.get_parameters(names)
    probe.wait_until(answer.done, 'the values')
    values = [parameter_value_to_python(value) for value in answer.result().values]
    assert len(values) == len(names)
    return dict(zip(names, values, strict=True))


def parameter_file(path: Path, node: str, values: dict[str, Any]) -> str:
    path.write_text(yaml.dump({f'/{node}': {'ros__parameters': {
        name: value.tolist() if isinstance(value, array) else value
        for name, value in values.items()
    }}}))
    return str(path)


def test_what_was_dumped_is_complete_and_loads_without_a_change(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        started = {
            'controller': {'control.max': 5.0, 'estimator.output_noise_std': 1e-6},
            'plant': {'backlash.m': 0.9, 'seed': 4}, 'reference': {'amplitude': 3.0},
            'recorder': {},
        }
        probe = world.probe()
        for name, parameters in started.items():
            node = world.start(name, {'wait_for_subscribers': 1, **parameters} if name in (
                'plant', 'reference') else parameters)
            before = dumped(probe, name)
            declared = {p.name for p in PARAMETERS if name in p.used_by}
            assert declared <= before.keys()
            for key, value in parameters.items():
                assert before[key] == value
            client = AsyncParameterClient(probe.node, name)
            file = parameter_file(tmp_path / f'{name}.yaml', name, before)
            loaded = client.load_parameter_file(file, True)
            probe.wait_until(loaded.done, 'an answer')
            assert [r.reason for r in loaded.result().results if not r.successful] == []
            assert dumped(probe, name) == before
            assert node.stop() == 0
            # A node that starts with it is the same one.
            again = world.start(name, None, '--ros-args', '--params-file', file)
            assert dumped(probe, name) == before
            assert again.stop() == 0


def test_values_as_command_lines_send_them_are_taken_or_refused_by_name(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        plant = world.start('plant')
        client = Client(world.probe(), 'plant')
        assert client.change(output_noise_std='1e-6', backlash__jump=[1, 2, 3]).successful
        assert client.change(backlash__rate='[1.0e-05, 0.0, 0]').successful
        refused = client.change(output_noise_std='little')
        assert refused.reason == "output_noise_std='little' must be a number"
        refused = client.change(backlash__jump=[1, 2])
        assert refused.reason == 'backlash.jump=[1.0, 2.0] must have 3 numbers'
        assert plant.stop() == 0
