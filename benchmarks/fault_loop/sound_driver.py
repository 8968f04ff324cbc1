"""What is said of a loop in which all is well but for the rate of the driver."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np

from backlash_ros.core.loop.diagnosis import Neighbours, figures_of_loop, findings_of
from backlash_ros.core.loop.finding import Level
from backlash_ros.core.loop.loop_statistics import Lately
from backlash_ros.core.parameters import Parameters
from fault_loop.fault_controller import Controller
from fault_loop.fault_world import Actuator, Driver, Sensor

# Who is on the topics is known to a node alone.
OF_TOPICS = ('waiting for output', 'unheard')


def blamed(
    hz: float, slow: float, jitter: float, seconds: float, values: Mapping[str, object],
) -> tuple[list[str], Counter[str]]:
    """Texts that came first, as warning or error, second by second, and how often each kind.

    slow, jitter: as in Driver. The plant goes on in its own time: to a slow driver it is faster.
    """
    p = Parameters({'sample_period': 1.0 / hz, 'truth.scale_frequency': 1.0 + slow, **values})
    rng = np.random.default_rng(1)
    driver = Driver(p, rng, Actuator(), Sensor(rng, 10.0), False, slow=slow, jitter=jitter)
    controller = Controller(p, driver, None, lambda v, limits: None, lambda step, renewed: None)
    lately, texts, kinds = Lately(), [], Counter[str]()
    for k in range(round(seconds * hz)):
        driver.advance()
        controller.run(driver.reference(driver.tick * p.sample_period))
        if k % round(hz) == 0:
            loop = controller.loop
            said = [
                finding for finding in findings_of(figures_of_loop(
                    loop, p, loop.counter.sender.timing(), lately.gained(loop.counted, k / hz),
                    Neighbours(),
                ))
                if finding.level > Level.OK and finding.kind not in OF_TOPICS
            ]
            texts += [finding.text for finding in said[:1]]
            kinds.update(finding.kind for finding in said)
    return texts, kinds
