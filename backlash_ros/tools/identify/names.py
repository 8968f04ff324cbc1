"""Names of the files that `identify` writes, and what --integrator may say."""

from __future__ import annotations

YAML, JSON, PAGE = 'identified.yaml', 'identified.json', 'identify.html'
ESTIMATES = 'estimates.json'
INTEGRATORS = {'auto': (False, True), 'yes': (True,), 'no': (False,)}
