"""Identify a measured record; write the files of the result and the page; print the outcome."""

import argparse
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from backlash_ros.atomic_file import write_atomically
from backlash_ros.core.assembly import build_controller, first_guess
from backlash_ros.core.estimate import Estimate, save_estimate
from backlash_ros.core.identification.actuator import with_actuator
from backlash_ros.core.identification.identification import Details, Identification, identify
from backlash_ros.core.identification.structure_search import Options
from backlash_ros.core.parameters import BRINGUP, BY_NAME, PLANT, ParameterError, Parameters, Value
from backlash_ros.core.records.record import Record
from backlash_ros.tools.cli import BrokenOffError, format_table
from backlash_ros.tools.config import ANY, config_text
from backlash_ros.tools.page import Picture, table, write_page
from backlash_ros.tools.records.columns import COMMAND, ROLES
from backlash_ros.tools.runs.files import result_directory, write_summary, write_table

YAML = 'identified.yaml'


def identify_record(
    record: Record, options: argparse.Namespace, progress: Callable[[str], object],
) -> Identification:
    """Identify a record with the options of the command line; raises BrokenOffError."""
    integrators = {'auto': (False, True), 'yes': (True,), 'no': (False,)}[options.integrator]
    try:
        found = identify(record.v, record.y, record.sample_period, Options(
            options.order, options.delay, integrators, options.slope), progress)
        return found if record.commands is None else with_actuator(found, record.commands)
    except np.linalg.LinAlgError as error:
        raise BrokenOffError(f'the record cannot be fitted: {error}') from error


def write_outcome(
    found: Identification, record: Record, given: Mapping[str, Value],
    options: argparse.Namespace,
) -> bool:
    """Write the files, print the outcome; returns whether the backlash is known."""
    out = result_directory(options.out)
    estimates, text = out.resolve() / 'estimates.json', None
    for earlier in (out / YAML, estimates):  # of another record, if any
        earlier.unlink(missing_ok=True)
    if found.usable:
        try:
            parameters = identified_parameters(found, given, estimates)
            text = commented_yaml(parameters, found, record.source, options.axis)
            write_atomically(out / YAML, text)
            save_estimate(estimates, as_estimate(found, parameters), parameters)
        except ParameterError as error:
            found = replace(found, refused=f'the controller does not take it: {error}')
    write_summary({**numbers(found), 'timing': record.timing, 'notes': record.notes},
                  out / 'identified.json')
    write_record(replace(record, v=found.v), out / 'record.csv')
    known = found.verdict is not None and found.verdict.backlash.known
    lines = found.verdict.lines if found.verdict else ()
    refused = [f'no {YAML}: {found.refused}'] if found.refused else []
    notes = [*record.notes, *found.remarks]
    constants = [(name, f'{getattr(found, name):.6g}', f'{found.std[name]:.2g}')
                 for name in ('gap', 'c_r', 'c_l', 'm') if found.std]
    head, facts = ('', 'found', '±'), _facts(found, record)
    write_page(
        out / 'identify.html', 'Identification of backlash and G(z)',
        f'<b>The backlash is {"" if known else "not "}known</b>: {len(found.y)} samples of '
        f'{found.sample_period:g} s from {escape(record.source)}.', [*lines, *refused, *notes],
        [table(head, constants) + table((), [(name, escape(fact)) for name, fact in facts])]
        if constants else [], list(_pictures(found)), None if text is None else (YAML, text))
    print('\n'.join([
        *lines, *([format_table(head, constants)] if constants else []),
        *map(': '.join, facts), *(f'note: {note}' for note in notes), *refused,
        str(out / (YAML if found.usable else 'identified.json')), str(out / 'identify.html')]))
    return known


def _pictures(found: Identification) -> Iterator[Picture]:
    """Figures by which a person can judge the result; none if nothing was fitted."""
    # Ctrl-C has to wait until Matplotlib is loaded, which would take it for a failed import.
    signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    from backlash_ros.tools import figures
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    for name, heading, caption, draw in (
        ('held_out.png', 'Measured and simulated y on samples that were held out',
         'Simulated from v alone, with a model that was fitted to the samples before: the lines '
         'should lie on each other, and the difference should look like noise.',
         figures.draw_held_out),
        ('loop.png', 'The backlash',
         'Left: y over v as measured. Right: what the backlash that was found takes from v, over '
         'v: c<sub>r</sub> while v pushes to the right, c<sub>l</sub> to the left, and in between '
         'while v crosses the gap after each turn.', figures.draw_loop),
        ('residual.png', 'Residual of the fit',
         'y minus the simulation of the whole record. Its autocorrelation should stay within the '
         'band of white noise; the rounding of an encoder may leave it. Over v it should show no '
         'shape: a slope or a hook is a nonlinearity that is not in the model.',
         figures.draw_residual),
        ('bode.png', 'Frequency response of m G',
         'How much and how late y answers to u, with a band of two standard deviations. Between '
         'the dotted lines y moved; outside of them the record says little.', figures.draw_bode),
    ):
        if found.details is not None:
            yield Picture(name, heading, caption, figures.png(draw(found, found.details)))


def write_record(record: Record, path: Path) -> None:
    """Write t, v, y, and the commands if they differ from v, as a CSV that `identify` reads."""
    columns = [record.sample_period * np.arange(len(record.v)), record.v, record.y, record.commands]
    rows = np.column_stack([values for values in columns if values is not None]).tolist()
    write_table(path, (*ROLES, COMMAND)[:len(rows[0])], rows)


def _facts(found: Identification, record: Record) -> list[tuple[str, str]]:
    """What was found besides the backlash, as (name, text), for the terminal and the page."""
    g = found.model
    facts = [('time', record.timing), ('lost samples, outliers', f'{record.lost}, {g.outliers}')]
    if found.details is not None:
        band, held_out = found.hertz, found.details.held_out
        alike = f' ({g.delays[0]} to {g.delays[-1]} fit alike)' if len(g.delays) > 1 else ''
        facts += [
            ('G(z)', f'{len(g.denominator) - 1} poles{", one of them an integrator" * g.integrator}'
                     f', delay {g.delay}{alike}, known to {100.0 * g.response_std.max():.2g} % '
                     f'from {band[0]:.2g} to {band[-1]:.2g} Hz'),
            ('poles', ', '.join(f'{pole:.5g}' for pole in np.roots(g.denominator).tolist())),
            ('noise of y', f'{g.noise_std:.3g}'
                           + (f', steps of {g.quantum:.3g}' if g.quantum else '')),
            ('error on samples held out', f'{held_out.rms:.3g} (fit: {held_out.trained:.3g})')]
    if (actuator := found.actuator) is not None:
        right, left = actuator.wind_up
        facts.append(('L(z), from control to applied_control',
                     f'{actuator.lag.order} poles, gain {actuator.gain:.6g}; wind-up {right:.4g} '
                     f'on the right, {left:.4g} on the left'))
    return facts


def identified_parameters(
    found: Identification, given: Mapping[str, Value], estimates: Path | None = None,
) -> Parameters:
    """The complete set: identified values, others as the user gave them, defaults for the rest.

    estimates: file with which the controller is to start. Raises ParameterError if the controller
    does not accept the set.
    """
    # Given parameters that are not taken over: of the simulation, of a single run, and of an
    # actuator, which is outdated if v is the command.
    not_taken_over = (
        'truth', 'backlash', 'output_noise_std', 'output_quantum', 'input_disturbance', 'estimates',
        'bag', 'lockstep', 'wait_for_subscribers', 'wait_for_publishers', 'axes', 'actuator')
    wider = 3.0  # bounds of the estimates, as multiples of what was found
    assert found.details is not None
    reach = max(abs(found.c_r), abs(found.c_l)) + found.std['c_r']
    scale = _short(max(wider * max(found.gap, reach), 1e-9))
    c_r, c_l, g = _short(found.c_r, 6), _short(found.c_l, 6), found.model
    actuator: dict[str, Any] = {}
    if found.actuator is not None:
        (right, left), lag = found.actuator.wind_up, found.actuator.lag
        actuator = {'actuator.numerator': tuple(lag.numerator.tolist()),
                    'actuator.denominator': tuple(lag.denominator.tolist()),
                    'actuator.wind_up': (_short(right, 6), _short(left, 6))}
    # Decimal places by the swing of v, wherever its zero is.
    digits = 3 - int(np.floor(np.log10(np.ptp(found.v))))
    values: dict[str, Any] = {
        # Unless limits are given, v may go as far and as fast as it did in the record.
        'control.min': round(float(found.v.min()), digits),
        'control.max': round(float(found.v.max()), digits),
        'control.rate_max': _short(np.abs(np.diff(found.v)).max() / found.sample_period, 4),
        # A record of several speeds knows G better than a motion that the loop happens to make.
        'plant.adapt': False,
        **_weights(found, found.details),
        **({'estimator.use_applied_control': 'true'} if actuator else {}),
        **(_reference(found, found.details)
           if not {'waveform', 'amplitude', 'frequency', 'bias', 'file'} & set(given) else {}),
        **{name: value for name, value in given.items() if not name.startswith(not_taken_over)},
        'sample_period': found.sample_period,
        'plant.numerator': g.numerator, 'plant.denominator': g.denominator,
        'plant.uncertainty': g.uncertainty, 'control.delay_samples': g.delay,
        **actuator,
        'estimator.initial.m': found.m,
        'estimator.initial.c_r': c_r, 'estimator.initial.c_l': c_l,
        'estimator.bounds.m': (_short(found.m / wider), _short(found.m * wider)),
        'estimator.bounds.c_r': (-scale, scale), 'estimator.bounds.c_l': (-scale, scale),
        'estimator.output_noise_std': _short(max(g.noise_std, 1e-12)),
        # The simulated plant is the identified one, so that the file can be tried out.
        'backlash.m': found.m, 'backlash.c_r': c_r, 'backlash.c_l': c_l,
        'output_quantum': _short(g.quantum, 6),
        'output_noise_std': 0.0 if g.quantum else _short(g.noise_std),
        **({'estimates.file': str(estimates), 'estimates.load': True} if estimates else {}),
    }
    if 'structure' not in given:
        # tracking, if gains for it can be designed, else u_d = y_m.
        try:
            return _accepted({**values, 'structure': 'tracking'})
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            values.update({'structure': 'proportional', 'proportional.f': 0.0})
    return _accepted(values)


def _accepted(values: Mapping[str, Any]) -> Parameters:
    parameters = Parameters(values)
    # From first_guess, as estimates.file is not written yet.
    build_controller(parameters, first_guess(parameters))
    return parameters


def _short(value: float, digits: int = 3) -> float:
    return float(f'{value:.{digits}g}')


def _reference(found: Identification, details: Details) -> dict[str, Value]:
    """Parameters of a reference that the actuator can follow and that crosses the gap."""
    y = found.y[np.isfinite(found.y)]
    middle = 0.0 if found.model.integrator else 0.5 * float(np.percentile(y, [5, 95]).sum())
    gain = float(np.abs(details.response.at(found.model.frequencies[:1]))[0])
    reach = 0.5 * (float(np.ptp(found.v)) - found.gap)
    share = max(0.4, min(0.75 * found.gap / reach, 0.8))
    return {
        'waveform': 'sine', 'amplitude': _short(share * gain * reach), 'bias': _short(middle),
        'frequency': _short(found.model.frequencies[0] / found.sample_period)}


def _weights(found: Identification, details: Details) -> dict[str, Value]:
    """Tracking parameters with the usual weight of u at a frequency where G is known and large."""
    # Up to the frequency [rad/sample] at which tracking.input_weight refers to |G|.
    w = np.linspace(found.model.frequencies[0], np.pi / 10.0, 200)
    gain = np.abs(details.response.at(w))
    if found.actuator is not None:
        gain = gain * np.abs(found.actuator.lag.response(np.exp(1j * w)))
    # Below a tenth of the gain at the lowest frequency, motion of y needs too much v.
    beyond = np.flatnonzero((w > details.response.known_up_to) | (gain < 0.1 * gain[0]))
    if not len(beyond):
        return {}
    last, usual = max(int(beyond[0]) - 1, 0), Parameters().tracking
    return {
        'tracking.input_weight': _short(usual.input_weight * max(gain[last] / gain[-1], 1.0)**2, 2),
        # Nearly one period of motion at that frequency.
        'tracking.preview': min(max(round(6.0 / w[last]), usual.preview), 600)}


def as_estimate(found: Identification, parameters: Parameters) -> Estimate:
    """The estimate with which a controller can start, as if it had learned it itself."""
    # A standard deviation of 0 would mean that the constant is given.
    least = 1e-6 * max(found.gap, abs(found.c_r), abs(found.c_l))
    initial = parameters.estimator.initial
    return Estimate(
        found.m, initial.c_r, initial.c_l, parameters.proportional.f,
        max(found.std['m'], 1e-6 * found.m), max(found.std['c_r'], least),
        max(found.std['c_l'], least))


def numbers(found: Identification) -> dict[str, Any]:
    """Content of identified.json."""
    held_out, actuator = found.details and found.details.held_out, found.actuator
    g, verdict = found.model, found.verdict
    of_all = ('usable', 'reasons', 'remarks', 'm', 'gap', 'c_r', 'c_l', 'sample_period')
    of_model = ('numerator', 'denominator', 'integrator', 'uncertainty', 'outliers')
    return {
        **{name: getattr(found, name) for name in of_all},
        **{name: getattr(g, name) for name in of_model},
        'known': verdict and {name: getattr(verdict, name)._asdict()
                              for name in ('backlash', 'gain', 'model')},
        'offset': 0.5 * (found.c_r + found.c_l),
        'std': dict(found.std) or dict.fromkeys(('m', 'gap', 'c_r', 'c_l')),
        'delay_samples': g.delay, 'equally_good_delays': g.delays,
        'output_noise_std': g.noise_std, 'output_quantum': g.quantum,
        'response': {'frequency_hz': found.hertz.tolist(),
                     'relative_std': g.response_std.tolist()},
        'held_out': held_out and {'rms': held_out.rms, 'rms_of_fit': held_out.trained},
        'actuator': actuator and {
            'numerator': actuator.lag.numerator.tolist(),
            'denominator': actuator.lag.denominator.tolist(), 'wind_up': actuator.wind_up},
        'samples': len(found.y), 'lost_samples': int(np.isnan(found.y).sum()),
    }


def commented_yaml(
    parameters: Parameters, found: Identification, source: str, axis: str = '',
) -> str:
    """Text of a parameter file with a comment for each value, and the ± of those identified."""
    band, std = found.hertz, found.std
    comments = {
        'plant.numerator': f'G to ± {100.0 * found.model.response_std.max():.2g} % from '
                           f'{band[0]:.2g} to {band[-1]:.2g} Hz; its gain is that for m = '
                           f'{found.m:g}, ± {100.0 * std["m"] / found.m:.2g} %',
        'estimator.initial.m': 'as given with --slope, 1 if it was not: G has the gain for it',
        'estimator.initial.c_r': f'± {std["c_r"]:.2g} [v]',
        'estimator.initial.c_l': f'± {std["c_l"]:.2g} [v]',
        'estimator.output_noise_std': 'rms deviation of y from the simulation [y]',
    }
    lines = [
        f'# Identified from {source}: {len(found.y)} samples of {found.sample_period:g} s.',
        f'# {"; ".join(found.remarks)}.' if found.remarks else '# There are no remarks.',
        '# Values with ± were identified, the others were given or are defaults.']
    path: list[str] = []
    for line in config_text(parameters).splitlines():
        path[(len(line) - len(line.lstrip())) // 2:] = [line.split(':')[0].strip()]
        entry = BY_NAME.get('.'.join(path[2:]))
        if entry is not None:
            simulated = 'the simulated plant: ' if entry.used_by == (PLANT,) else ''
            unit = f' [{entry.unit}]' if entry.unit else ''
            comment = comments.get(entry.name) or f'{simulated}{entry.description}{unit}'
            line = f'{line.ljust(52)}  # {comment}'
        lines.append(line)
    text = '\n'.join([*lines, ''])
    if axis:
        text = text.replace(f'\n/{ANY}:', f'\n/{axis}/{ANY}:')
        text += f"/{BRINGUP}:\n  ros__parameters:\n    axes: ['{axis}']\n"
    return text
