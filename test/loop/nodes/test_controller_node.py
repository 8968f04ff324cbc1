"""The controller as a managed node: its states, its services, its parameters, its last commands."""

import json
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from node_in_process import Bench, bench, look_for_silence, node_with
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from backlash_ros import topics
from backlash_ros.core.loop.control_loop import Phase
from backlash_ros.tools.bringup.supervisor import free_domain

RATE_MAX = 400.0
STEP = RATE_MAX * 0.01 * (1.0 + 1e-9)
GAP = 5.0  # less than that of the plant
CHEAP: dict[str, object] = {'estimator.law': 'lms'}  # where the law does not matter
CONFIGURE, ACTIVATE = Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE
DEACTIVATE, CLEANUP = Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP


def estimates(made: Bench) -> tuple[float, float, float]:
    e = made.loop.estimate
    return e.m, e.c_r, e.c_l


def test_it_goes_through_its_life_and_commands_only_while_active() -> None:
    with bench(active=False, **CHEAP) as made:
        made.run(5)
        assert made.state == 'unconfigured'
        assert not made.set_bool('freeze_adaptation', True)
        assert made.change(CONFIGURE)
        made.run(5)
        assert (made.state, made.sent) == ('inactive', [])
        assert made.change(ACTIVATE)
        made.run(50)
        assert len(made.sent) == 50
        assert not made.change(CONFIGURE)  # does not fit, harms nobody
        assert made.change(DEACTIVATE)
        made.run(5)
        assert len(made.sent) == 50
        assert made.change(CLEANUP)
        assert made.state == 'unconfigured'
        assert made.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
        assert made.state == 'finalized'


@pytest.mark.parametrize('steps', [
    (DEACTIVATE, ACTIVATE), (DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE),
], ids=['deactivated', 'cleaned up'])
def test_it_goes_on_from_its_last_command_and_uses_no_sample_number_twice(steps):
    with bench(**CHEAP, **{'control.rate_max': RATE_MAX, 'on_stop': 'hold'}) as made:
        first = estimates(made)
        made.run(300)
        known, index = estimates(made), made.loop.counter.index
        assert known != first
        assert made.change(*steps)
        if CLEANUP not in steps:
            assert estimates(made) == known
        made.run(50)
        assert np.abs(np.diff(made.sent)).max() <= STEP
        assert made.loop.counter.index == index + 50


@pytest.mark.parametrize('action', ['hold', 'zero', 'ramp'])
def test_the_last_commands_are_as_on_stop_says(action: str) -> None:
    with bench(**CHEAP, **{'on_stop': action, 'control.rate_max': RATE_MAX,
                           'timeout.ramp': 60.0}) as made:
        made.run(100)
        while abs(made.sent[-1]) < 5.0:
            made.run(1)
        before = len(made.sent)
        assert made.change(DEACTIVATE)
        last = made.sent[before - 1:]
        assert np.abs(np.diff(last, append=last[-1])).max() <= STEP
        if action == 'hold':
            assert len(last) == 1
        else:
            assert last[-1] == 0.0


@pytest.mark.parametrize('action', ['hold', 'zero', 'ramp'])
def test_the_commands_of_a_silence_are_as_on_timeout_says(action: str) -> None:
    with bench(**CHEAP, **{'on_timeout': action, 'control.rate_max': RATE_MAX}) as made:
        made.run(100)
        while abs(made.sent[-1]) < 5.0:
            made.run(1)
        before = len(made.sent)
        look_for_silence(made.node)
        assert made.loop.phase is Phase.SILENT
        if action != 'hold':
            made.wait_until(lambda: made.sent[-1] == 0.0, 'v at 0')
        ended = len(made.sent)
        assert (ended == before) == (action == 'hold')
        made.run(50)
        assert made.loop.statistics.interruptions == 1
        assert made.loop.phase is Phase.RUNS
        assert np.abs(np.diff(made.sent)).max() <= STEP


def test_a_silence_before_the_end_takes_back_nothing_that_was_told_of_the_noise() -> None:
    with bench() as made:
        told = made.probe.collect(topics.MODEL, Float64MultiArray)
        made.wait_until(lambda: made.probe.node.count_publishers(topics.MODEL), 'a publisher')
        made.run(400)
        look_for_silence(made.node)
        made.wait_until(lambda: told, topics.MODEL)
        assert made.change(DEACTIVATE)
        for _ in range(20):
            made.serve()
        index = sum(dim.size for dim in told[-1].layout.dim[:-2])
        assert told[-1].layout.dim[-2].label == 'noise_ratio'
        assert told[-1].data[index] == pytest.approx(1.0, rel=0.2)


def test_estimates_are_frozen_reset_and_compensated_with_as_is_asked() -> None:
    with bench(**CHEAP) as made:
        made.run(300)
        assert made.set_bool('freeze_adaptation', True)
        made.run(5)
        held = estimates(made)
        made.run(100)
        assert estimates(made) == held
        assert made.set_bool('freeze_adaptation', False)
        made.run(200)
        assert estimates(made) != held
        assert np.abs(np.diff(made.sent[-100:])).max() > GAP
        assert made.set_bool('enable_compensation', False)
        made.run(120)
        assert np.abs(np.diff(made.sent[-100:])).max() < GAP
        assert made.set_bool('enable_compensation', True)
        made.run(120)
        assert np.abs(np.diff(made.sent[-100:])).max() > GAP
        assert made.trigger('reset_estimates').success
        assert estimates(made)[0] == 0.696


def test_estimates_are_saved_at_the_end_and_on_request_or_the_reason_is_told(tmp_path):
    file = tmp_path / 'estimates.json'
    with bench(**{'estimates.file': str(file), 'estimates.save_period': 0.0}) as made:
        made.run(50)
        assert made.trigger('save_estimates').message == 'nothing was learned yet'
        made.run(250)
        assert not file.exists()
        answer = made.trigger('save_estimates')
        assert answer.success, answer.message
        assert json.loads(file.read_text())['estimate']['m'] == pytest.approx(1.3, rel=0.02)
        file.unlink()
        assert made.change(DEACTIVATE)
    assert file.exists()
    nowhere = tmp_path / 'missing' / 'estimates.json'
    with bench(**{'estimates.file': str(nowhere), 'estimates.save_period': 0.0}) as made:
        made.run(300)
        answer = made.trigger('save_estimates')
        assert not answer.success
        assert 'cannot be written: No such file or directory' in answer.message


def test_a_slow_disk_holds_up_the_answer_but_not_the_loop(tmp_path, monkeypatch):
    confirmed, fsync = threading.Event(), os.fsync
    def slowly(file: int) -> None:
        confirmed.wait()
        fsync(file)
    monkeypatch.setattr(os, 'fsync', slowly)
    file = tmp_path / 'estimates.json'
    with bench(**{'estimates.file': str(file), 'estimates.save_period': 0.0}) as made:
        made.run(300)
        client = made.probe.node.create_client(Trigger, '/controller/save_estimates')
        made.wait_until(client.service_is_ready, 'the service')
        saved = client.call_async(Trigger.Request())
        try:
            assert made.set_bool('freeze_adaptation', True)
            made.run(50)
            assert len(made.sent) == 350
            assert not saved.done()
        finally:
            confirmed.set()
        made.wait_until(saved.done, 'the answer')
        assert saved.result().success


def test_live_parameters_change_together_or_not_at_all() -> None:
    with bench(structure='tracking', **{'control.min': -200.0, 'control.max': 200.0}) as made:
        made.run(200)
        assert made.set_parameters(
            tracking__input_weight=0.02, estimator__output_noise_std=2e-3, on_stop='zero',
            timeout__plant_output=0.8, inverse__caution=2.0, control__max=150,
        ).successful
        refused = made.set_parameters(control__max=5.0, on_timeout='ramp')
        assert not refused.successful
        assert 'needs a finite control.rate_max' in refused.reason
        refused = made.set_parameters(lms__step=0.5, control__min=160.0)
        assert refused.reason == 'control.min=160.0 must be < control.max=150.0'
        made.run(100)
        assert max(made.sent[-100:]) > 5.0
        refused = made.set_parameters(sample_period=0.02)
        assert 'is read-only while the node is configured: deactivate' in refused.reason


def test_noise_is_not_changed_live_for_a_law_that_would_not_take_it_up() -> None:
    with bench(**CHEAP) as made:
        made.run(10)
        refused = made.set_parameters(estimator__output_noise_std=2e-3)
        assert not refused.successful
        assert 'estimator.output_noise_std=0.002' in refused.reason
        assert 'not taken up live by lms' in refused.reason
        assert made.change(DEACTIVATE, CLEANUP)
        assert made.set_parameters(estimator__output_noise_std=2e-3).successful


def test_weights_are_not_changed_live_for_a_structure_that_would_not_take_them_up() -> None:
    with bench(structure='pole_placement') as made:
        made.run(10)
        refused = made.set_parameters(tracking__input_weight=0.5)
        assert 'not taken up live by pole_placement' in refused.reason
        assert made.set_parameters(inverse__direction_band=0.1).successful


def test_all_but_the_interface_may_change_while_unconfigured(tmp_path: Path) -> None:
    file = tmp_path / 'estimates.json'
    with bench(active=False, sample_period=0.5) as made:
        assert made.set_parameters(sample_period=0.01, estimator__initial__m=1.0).successful
        assert made.set_parameters(estimates__file=str(file)).successful
        assert 'must lie within' in made.set_parameters(estimator__initial__c_r=1e9).reason
        assert 'read-only' in made.set_parameters(io__style='ros2_control').reason
        assert made.change(CONFIGURE, ACTIVATE)
        made.run(1)
        assert estimates(made)[0] == 1.0
        made.run(300)
        assert made.trigger('save_estimates').success
        assert file.exists()


def test_who_publishes_a_remapped_topic_is_counted() -> None:
    with free_domain() as domain, node_with({}, domain, '-r', 'control:=/motor/v') as node:
        assert node.count_publishers('control') == node.count_publishers('/motor/v') == 1
