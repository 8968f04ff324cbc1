"""What a node tells the program that started it: one JSON object per line on stdout."""

from __future__ import annotations

import json
import os
from math import isfinite

ENABLED = os.environ.get('BACKLASH_ROS_EVENTS') == '1'


def emit(event: str, **content: object) -> None:
    """Print an event, flushed; nothing unless BACKLASH_ROS_EVENTS=1. JSON has no nan: null."""
    if ENABLED:
        checked = {name: _without_nan(value) for name, value in content.items()}
        print(json.dumps({'event': event, **checked}), flush=True)


def _without_nan(value: object) -> object:
    return None if isinstance(value, float) and not isfinite(value) else value
