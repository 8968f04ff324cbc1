"""The verdict on a driver: all findings in order, and the table that shows them."""

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
    MODEL,
    MOTION_SUBJECTS,
    NOISE,
    applied_findings,
    motion_findings,
    not_judged,
    record_of,
)
from backlash_ros.core.parameters import Parameters

MESSAGE_SUBJECTS = ('rate', 'jitter', 'lost samples', 'repeated samples', 'clock', 'values')
# Without these nothing that follows from time or motion means anything.
BASIC = {'publisher', 'type'}
BLURRED_BY_JITTER = {DELAY, MODEL, NOISE}
NEEDED_FOR_MOTION = {'listener', 'rate', 'clock'}
SIMILAR = 0.6  # of difflib: a topic that may be meant


def judge(graph: Graph, heard: Heard, p: Parameters) -> list[Finding]:
    """All findings; what a fault hides is said to be unknown, so that each fault shows once."""
    found = graph_findings(graph, bool(p.get('io.best_effort', False)))
    wrong = [f.subject for f in found if f.mark == WRONG and f.subject in BASIC]
    if graph.publishers == 0:
        return found
    if wrong:
        return found + _hidden(MESSAGE_SUBJECTS + MOTION_SUBJECTS, wrong[0])
    timing = timing_of(heard, p.sample_period)
    if timing is None:
        rate = Finding(
            'rate', WRONG, f'{len(heard.outputs)} samples heard, {FEWEST_SAMPLES} are needed',
            'see that plant_output is published without pause; raise --duration',
        )
        return [*found, rate, *_hidden(MESSAGE_SUBJECTS[1:] + MOTION_SUBJECTS, 'rate')]
    found += message_findings(heard, timing, p.sample_period)
    wrong = [f.subject for f in found if f.mark == WRONG and f.subject in NEEDED_FOR_MOTION]
    if wrong:
        return found + _hidden(MOTION_SUBJECTS, wrong[0])
    found += applied_findings(heard, timing, p)
    motion = motion_findings(record_of(heard, timing), p)
    if any(f.subject == 'jitter' and f.mark == WRONG for f in found):
        # Amid jitter it is uncertain which v led to which y: what fits does, what does not may.
        motion = [
            not_judged(f.subject, 'once jitter fits')
            if f.mark == WRONG and f.subject in BLURRED_BY_JITTER else f
            for f in motion
        ]
    return found + motion


def _hidden(subjects: Sequence[str], behind: str) -> list[Finding]:
    return [not_judged(subject, f'once {behind} fits') for subject in subjects]


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
    last = wanted.rsplit('/', 1)[-1]

    def likeness(topic: str) -> float:
        name = topic.rsplit('/', 1)[-1]
        alike = difflib.SequenceMatcher(None, last, name).ratio()
        return alike + (0.1 if wanted_type in seen[topic] else 0.0)

    near = [topic for topic in seen if topic != wanted and likeness(topic) >= SIMILAR]
    return sorted(near, key=lambda topic: (-likeness(topic), topic))
