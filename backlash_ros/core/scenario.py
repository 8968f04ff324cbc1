"""From checked parameters to what a controller meets: G(z), the simulated plant, y_m.

Apart from assembly.py, so that the nodes for these start without loading what learns and controls.
"""

from backlash_ros.core.parameters import Parameters
from backlash_ros.core.plant.actuator import Actuator
from backlash_ros.core.plant.simulated_plant import SimulatedPlant, altered_plant, delayed
from backlash_ros.core.plant.transfer_function import TransferFunction
from backlash_ros.core.reference.signal import ReferenceSignal


def build_model(p: Parameters) -> TransferFunction:
    """G(z), and the delay between control and its effect as poles at 0."""
    delay = (0.0,) * p.control.delay_samples
    return TransferFunction(p.plant.numerator, p.plant.denominator + delay)


def build_actuator(p: Parameters) -> Actuator | None:
    """What lies between control and applied_control; None where nothing does."""
    lag = p.actuator.numerator, p.actuator.denominator
    return Actuator(TransferFunction(*lag, 'actuator'), p.actuator.wind_up) if any(lag) else None


def build_true_model(p: Parameters) -> TransferFunction:
    """G(z) of the simulated plant, which truth.* may set apart from the one that is known."""
    truth, plant = p.truth, p.plant
    base = TransferFunction(
        truth.numerator or plant.numerator, truth.denominator or plant.denominator,
        'truth' if truth.numerator or truth.denominator else 'plant')
    altered = altered_plant(
        base, truth.scale_frequency, truth.scale_damping, truth.extra_lag / p.sample_period)
    samples = truth.delay_samples if truth.delay_samples >= 0 else p.control.delay_samples
    return delayed(altered, samples)


def build_plant(p: Parameters) -> SimulatedPlant:
    """The simulated plant with its hidden backlash."""
    return SimulatedPlant(p, build_true_model(p), build_actuator(p))


def build_reference(p: Parameters) -> ReferenceSignal:
    """y_m(t); reads the file for waveform: file."""
    return ReferenceSignal(p)
