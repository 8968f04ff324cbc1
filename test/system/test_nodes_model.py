"""What the controller tells of G and of its own fit, with real processes."""

from __future__ import annotations

from math import isnan
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from drivers.paced_driver import NOISE, controller_and_driver
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_processes import Probe, ros_world
from std_msgs.msg import Float64MultiArray

from backlash_ros import topics
from backlash_ros.core.estimate import Status
from backlash_ros.core.loop.learned_model import LearnedModel, from_fields
from backlash_ros.core.parameters import Parameters

P = Parameters({})
UNCERTAIN: dict[str, object] = {'plant.uncertainty': 0.2}


def models_heard(probe: Probe) -> list[Float64MultiArray]:
    """What a subscriber hears that may come late."""
    heard: list[Float64MultiArray] = []
    late = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    probe.node.create_subscription(Float64MultiArray, topics.MODEL, heard.append, late)
    return heard


def model_of(message: Float64MultiArray) -> LearnedModel:
    """By the labels and sizes of the message alone."""
    fields, first = {}, 0
    for dimension in message.layout.dim:
        fields[dimension.label] = list(message.data[first:first + dimension.size])
        first += dimension.size
    assert first == len(message.data)
    return from_fields(fields)


def test_who_listens_late_hears_the_told_model_before_anything_is_learned(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller = world.start('controller', {**UNCERTAIN, 'control.delay_samples': 1})
        controller.wait_for('ready')
        probe = world.probe()
        heard = models_heard(probe)
        probe.wait_until(lambda: heard, 'the model')
        model = model_of(heard[-1])
        assert model.numerator == P.get_floats('plant.numerator')
        assert model.denominator == P.get_floats('plant.denominator')
        assert model.delay_samples == 1
        assert all(map(isnan, (*model.response_std, model.noise_ratio, model.unexplained)))
        assert controller.stop() == 0


def test_what_was_learned_is_told(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        told = 2.0 * NOISE
        controller, driver = controller_and_driver(
            world, **UNCERTAIN, **{'estimator.output_noise_std': told}
        )
        heard = models_heard(driver.probe)
        driver.learn()
        driver.run_until(
            lambda: heard and not isnan(model_of(heard[-1]).noise_ratio), 'the learned model'
        )
        # Late commands look like noise, or contradict, for a while.
        right = pytest.approx(0.5, rel=0.3)
        driver.run_until(
            lambda: model_of(heard[-1]).noise_ratio == right
            and driver.value('noise: learned / told') == right
            and driver.text('state') == 'tracking', 'the noise as it is',
        )
        model = model_of(heard[-1])
        assert 0.0 <= model.unexplained < 0.1
        assert all(0.0 < std < 1.0 for std in model.response_std)
        assert driver.text('G(z)') in ('as told', 'learned')
        assert driver.text('failed fits') == '0'
        for key in ('unexplained motion / (m * gap)', 'samples that wait for a fit', 'outliers'):
            assert driver.text(key), key
        assert controller.stop() == 0


def test_negative_slope_is_an_error_within_two_seconds(tmp_path: Path) -> None:
    with ros_world(tmp_path) as world:
        controller, driver = controller_and_driver(world)
        driver.sent = lambda k, y: [-y]
        driver.run_until(
            lambda: driver.signals and driver.signals[-1].data[6] == Status.INCONSISTENT,
            'the contradiction',
        )
        label = topics.SIGNAL_LABELS.index('sample')
        first = driver.signals[0].data[label]
        assert (driver.signals[-1].data[label] - first) * P.get_float('sample_period') < 2.0
        driver.run_until(
            lambda: driver.says('plant_output moves against v: reverse it'), 'the sign'
        )
        # On a busy machine it may be put down to late samples at first.
        driver.run_until(
            lambda: (status := driver.status()) and status.level == DiagnosticStatus.ERROR,
            'the error',
        )
        assert controller.stop() == 0
