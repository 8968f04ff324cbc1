"""Parameters of reference and plant that change in a running node."""

from array import array
from pathlib import Path
from typing import Any

import yaml
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from ros_processes import Probe, ros_world
from std_msgs.msg import Float64, Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.parameters import BY_NAME


class Client:
    """Sets parameters of a node while the test listens."""

    def __init__(self, probe: Probe, node: str) -> None:
        self._probe, self._client = probe, AsyncParameterClient(probe.node, node)
        probe.wait_until(self._client.services_are_ready, f'the parameters of {node}')

    def change(self, **values: Any) -> Any:
        parameters = [
            Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]
        return self._probe.ask(
            lambda: self._client.set_parameters_atomically(parameters), 'an answer'
        ).result


def test_parameters_of_reference_and_plant_change_while_they_run(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        nodes = [world.start('reference', {'frequency': 6.0}), world.start('plant')]
        probe = world.probe()
        heard = probe.collect(topics.REFERENCE, Float64)
        truth = probe.collect(topics.TRUTH, Float64MultiArray)
        reference, plant = Client(probe, 'reference'), Client(probe, 'plant')
        probe.wait_until(lambda: len(truth) > 10, 'the plant')
        assert plant.change(backlash__m=2.0, backlash__c_r=1.0, output_noise_std=0.1).successful
        probe.wait_until(lambda: truth[-1].data[1:4].tolist() == [2.0, 1.0, -3.0], 'the change')
        refused = plant.change(backlash__c_l=1.5)
        assert 'backlash.c_l=1.5 must be < backlash.c_r=1.0' in refused.reason
        assert plant.change(output_noise_std='1e-6', backlash__jump=[1, 2, 3]).successful
        assert plant.change(backlash__rate='[1.0e-05, 0.0, 0]').successful
        refused = plant.change(output_noise_std='little')
        assert refused.reason == "output_noise_std='little' must be a number"
        refused = plant.change(backlash__jump=[1, 2])
        assert refused.reason == 'backlash.jump=[1, 2] must have 3 numbers'
        samples = [row.data[-1] for row in truth]
        assert samples == sorted(set(samples))
        assert reference.change(amplitude=2.0, bias=100.0, waveform='square').successful
        probe.wait_until(lambda: heard and heard[-1].data in (98.0, 102.0), 'the square wave')
        refused = reference.change(amplitude=-1.0)
        assert refused.reason == 'amplitude=-1.0 must be >= 0 [y_m]'
        assert not reference.change(waveform='file').successful
        assert 'read-only' in reference.change(sample_period=0.02).reason
        assert [node.stop() for node in nodes] == [0, 0]


def dumped(probe: Probe, node: str) -> dict[str, Any]:
    client = AsyncParameterClient(probe.node, node)
    probe.wait_until(client.services_are_ready, f'the parameters of {node}')
    names = sorted(probe.ask(client.list_parameters, 'the names').result.names)
    answer = probe.ask(lambda: client.get_parameters(names), 'the values')
    values = [parameter_value_to_python(value) for value in answer.values]
    assert len(values) == len(names)
    return dict(zip(names, values, strict=True))


def parameter_file(path: Path, node: str, values: dict[str, Any]) -> str:
    path.write_text(yaml.dump({f'/{node}': {'ros__parameters': {
        name: value.tolist() if isinstance(value, array) else value
        for name, value in values.items()}}}))
    return str(path)


def test_what_was_dumped_is_complete_and_loads_without_a_change(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        started = {
            'controller': {'control.max': 5.0, 'estimator.output_noise_std': 1e-6},
            'plant': {'backlash.m': 0.9, 'seed': 4}, 'reference': {'amplitude': 3.0},
            'recorder': {}}
        probe = world.probe()
        for name, parameters in started.items():
            node = world.start(name, {'wait_for_subscribers': 1, **parameters} if name in (
                'plant', 'reference') else parameters)
            before = dumped(probe, name)
            declared = {p.name for p in BY_NAME.values() if name in p.used_by}
            assert declared <= before.keys()
            for key, value in parameters.items():
                assert before[key] == value
            client = AsyncParameterClient(probe.node, name)
            file = parameter_file(tmp_path / f'{name}.yaml', name, before)
            loaded = probe.ask(lambda c=client, f=file: c.load_parameter_file(f, True), 'an answer')
            assert [r.reason for r in loaded.results if not r.successful] == []
            assert (dumped(probe, name), node.stop()) == (before, 0)
            # Who asks before the graph has forgotten it is never answered.
            probe.wait_until(lambda c=client: not c.services_are_ready(), 'its end')
            # A node that starts with it is the same one.
            again = world.start(name, None, '--ros-args', '--params-file', file)
            assert (dumped(probe, name), again.stop()) == (before, 0)
