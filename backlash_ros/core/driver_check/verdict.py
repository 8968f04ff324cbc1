"""All that there is to say of a driver, so that each fault shows once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence

from backlash_ros.core.driver_check.findings import (
    FEWEST_SAMPLES,
    FITS,
    WRONG,
    Finding,
    Graph,
    Heard,
    graph_findings,
    message_findings,
    timing_of,
)
from backlash_ros.core.driver_check.motion import (
    DELAY,
    G_OF_Z,
    MOTION_SUBJECTS,
    NOISE_ON_Y,
    applied_findings,
    motion_findings,
    not_judged,
    record_of,
)
from backlash_ros.core.parameters import Parameters


def judge(graph: Graph, heard: Heard, p: Parameters) -> list[Finding]:
    """All findings; what a fault hides is said to be unknown."""
    message_subjects = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
    found = graph_findings(graph, bool(p.get('io.best_effort', False)))
    if graph.publishers == 0:
        return found
    # Without these nothing that follows from time or motion means anything.
    if wrong := _wrong(found, 'publisher', 'type'):
        return found + not_judged(message_subjects + MOTION_SUBJECTS, wrong)
    timing = timing_of(heard, p.sample_period)
    if timing is None:
        rate = Finding(
            'rate', WRONG, f'{len(heard.outputs)} samples heard, {FEWEST_SAMPLES} are needed',
            'see that plant_output is published without pause; raise --duration',
        )
        return [*found, rate, *not_judged(message_subjects[1:] + MOTION_SUBJECTS, 'rate')]
    found += message_findings(heard, timing, p.sample_period)
    if wrong := _wrong(found, 'listener', 'rate', 'clock'):
        return found + not_judged(MOTION_SUBJECTS, wrong)
    found += applied_findings(heard, timing, p)
    motion = motion_findings(record_of(heard, timing), p)
    if _wrong(found, 'jitter'):
        # Amid jitter it is uncertain which v led to which y: what fits does, what does not may.
        motion = [
            line for f in motion for line in (
                not_judged([f.subject], 'jitter')
                if f.mark == WRONG and f.subject in (DELAY, G_OF_Z, NOISE_ON_Y) else [f])
        ]
    return found + motion


def _wrong(found: Iterable[Finding], *subjects: str) -> str:
    """The first of these subjects that is wrong."""
    return next((f.subject for f in found if f.mark == WRONG and f.subject in subjects), '')


def all_fit(findings: Iterable[Finding]) -> bool:
    """Whether nothing is wrong and nothing is left unknown."""
    return all(finding.mark == FITS for finding in findings)


def table(findings: Sequence[Finding]) -> str:
    """A line per finding, the cure below what is wrong."""
    width = max(len(finding.subject) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f'{finding.mark} {finding.subject.ljust(width)}  {finding.found}')
        if finding.cure:
            lines.append(f'  {" " * width}  → {finding.cure}')
    return '\n'.join(lines)


def similar_topics(
    wanted: str, wanted_type: str, seen: Mapping[str, Sequence[str]],
) -> list[str]:
    """Topics that may be the wanted one under another name, most similar first.

    wanted: fully qualified. seen: topics with their types.
    """
    def likeness(topic: str) -> float:
        last, other = (name.rsplit('/', 1)[-1] for name in (wanted, topic))
        alike = difflib.SequenceMatcher(None, last, other).ratio()
        return alike + (0.1 if wanted_type in seen[topic] else 0.0)

    near = [topic for topic in seen if topic != wanted and likeness(topic) >= 0.6]
    return sorted(near, key=lambda topic: (-likeness(topic), topic))
