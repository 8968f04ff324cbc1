"""A driver that is a little slow, and nothing else: no healthy part is blamed."""

import pytest
from fault_loop.sound_driver import blamed

NOISY = {'output_noise_std': 1e-3, 'estimator.output_noise_std': 1e-3, 'plant.uncertainty': 0.2}


@pytest.mark.parametrize(('hz', 'slow', 'structure', 'said'), [
    (50.0, 0.09, 'tracking', 'plant_output comes at 45.'),
    (100.0, 0.005, 'proportional', 'plant_output comes at 99.'),
    (500.0, 0.06, 'proportional', 'plant_output comes at 47'),
    (200.0, 0.003, 'tracking', ''),
])
def test_of_a_slow_driver_its_rate_is_named_and_nothing_else(hz, slow, structure, said) -> None:
    wave = {'frequency': 0.126 * hz, 'structure': structure}
    texts, kinds = blamed(hz, slow, 0.05, 4.0 + 200.0 / hz, {**NOISY, **wave})
    assert set(kinds) == ({'rate'} if said else set())
    assert all(text.startswith(said) for text in texts)
    assert len(texts) >= 3 * bool(said)
