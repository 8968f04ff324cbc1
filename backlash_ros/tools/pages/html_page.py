"""One self-contained HTML page: no script, no font, no picture from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from math import isfinite
from typing import Any

NAMES = {'m': 'm', 'c_r': 'c<sub>r</sub>', 'c_l': 'c<sub>l</sub>'}
UNITS = {'m': 'of u/v', 'c_r': 'of v', 'c_l': 'of v'}
NOTHING = '–'

STYLE = """
body { font: 16px/1.5 system-ui, 'Segoe UI', 'Helvetica Neue', Arial, sans-serif;
       color: #222; background: #f6f6f4; margin: 0; }
main { max-width: 1060px; margin: 0 auto; padding: 24px; }
h1 { font-size: 26px; margin: 0 0 4px; }
h2 { font-size: 19px; margin: 0 0 4px; }
p { margin: 0 0 12px; }
section { background: #fff; border: 1px solid #ddd; border-radius: 8px; padding: 18px 20px;
          margin-top: 18px; }
sub { line-height: 0; }
table { border-collapse: collapse; width: 100%; }
th, td { padding: 5px 10px; text-align: right; border-bottom: 1px solid #e6e6e6;
         font-variant-numeric: tabular-nums; }
th:first-child, td:first-child { text-align: left; }
th { font-weight: 600; color: #555; }
.facts { margin-top: 18px; }
.facts td { width: 25%; }
.facts td:nth-child(odd) { text-align: left; color: #555; }
.facts td:nth-child(even) { text-align: left; }
.lead { color: #444; }
.warning { background: #fff4e0; border-left: 4px solid #E69F00; padding: 8px 12px; }
img { width: 100%; height: auto; display: block; }
pre { overflow-x: auto; font-size: 13px; background: #f6f6f4; padding: 12px; }
summary { cursor: pointer; font-weight: 600; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of the report: name of its PNG file, heading, what to see in it."""

    name: str
    heading: str
    caption: str
    data: bytes


def render_page(
    title: str, summary: Mapping[str, Any], pictures: Sequence[Picture], warnings: Sequence[str],
    configuration: str | None,
) -> str:
    """The page as text.

    summary: as in summary.json. configuration: the effective parameters as YAML, if known.
    """
    parts = [
        f'<h1>{escape(title)}</h1>', f'<p class="lead">{headline(summary)}</p>',
        *(f'<p class="warning">{escape(warning)}</p>' for warning in warnings),
        '<section>', _backlash_table(summary), _facts_table(summary), '</section>',
        *(picture_section(picture) for picture in pictures),
    ]
    if configuration is not None:
        parts += [
            '<section><details><summary>Parameters of this run</summary>',
            f'<pre>{escape(configuration)}</pre></details></section>',
        ]
    return page(title, parts)


def page(title: str, parts: Sequence[str]) -> str:
    """A page of these parts, which are HTML."""
    return '\n'.join([
        '<!DOCTYPE html>', '<html lang="en">', '<head>', '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<title>{escape(title)}</title>', f'<style>{STYLE}</style>', '</head>', '<body>',
        '<main>', *parts, '</main>', '</body>', '</html>', '',
    ])


def picture_section(picture: Picture) -> str:
    """A section with a heading, what to see, and the picture itself."""
    encoded = base64.b64encode(picture.data).decode('ascii')
    return '\n'.join([
        '<section>', f'<h2>{escape(picture.heading)}</h2>', f'<p>{picture.caption}</p>',
        f'<img alt="{escape(picture.heading)}" src="data:image/png;base64,{encoded}">',
        '</section>',
    ])


def headline(summary: Mapping[str, Any]) -> str:
    """The outcome in one sentence."""
    law = summary['estimator']
    who = f'The law <b>{escape(law)}</b>' if law else 'The controller'
    if summary['truth']['m'] is None:
        return f'{who} estimated the backlash; no truth was recorded to compare with.'
    times = summary['settling_time_s']
    late = [NAMES[name] for name, time in times.items() if time is None]
    if late:
        return f'{who} did not bring {" and ".join(late)} to within 1 % of the truth.'
    return (
        f'{who} has had m, c<sub>r</sub> and c<sub>l</sub> within 1 % of the truth since '
        f'<b>{_number(max(times.values()))} s</b>.'
    )


def _backlash_table(summary: Mapping[str, Any]) -> str:
    header = ('', 'estimate', 'std. deviation', 'truth', 'error', 'within 1 % from', 'unit')
    rows: list[Sequence[str]] = []
    for name, symbol in NAMES.items():
        final, truth = summary['final'][name], summary['truth'][name]
        settled = summary['settling_time_s'][name]
        rows.append((
            symbol, _number(final, 6), _number(summary['final_std'][name], 2),
            _number(truth, 6), relative_error(final, truth),
            NOTHING if truth is None else 'never' if settled is None else f'{settled:.4g} s',
            UNITS[name],
        ))
    rows.append(('f', _number(summary['final']['f'], 6), *[NOTHING] * 4, 'of u/v'))
    return table(header, rows)


def relative_error(final: float, truth: float | None) -> str:
    """Error in percent of the truth, as text."""
    if truth is None or truth == 0.0:
        return NOTHING
    return f'{100.0 * (final - truth) / abs(truth):+.2g} %'


def _facts_table(summary: Mapping[str, Any]) -> str:
    latency = summary['loop_latency_ms']
    control, tracking = summary['control_error_rms'], summary['tracking_error_rms']
    duration = summary['samples'] + summary['lost_samples']
    unexplained, share = summary['unexplained'], summary['status_share']
    facts = [
        ('samples', f'{summary["samples"]} in {duration * summary["sample_period"]:.6g} s'),
        ('lost samples', str(summary['lost_samples'])),
        ('sample period', f'{summary["sample_period"]:.6g} s'),
        ('structure', escape(summary['structure'] or NOTHING)),
        ('control error RMS, last second',
         NOTHING if control is None else f'{control:.4g} [unit of u]'),
        ('tracking error RMS, last half',
         NOTHING if tracking is None else f'{100.0 * tracking:.3g} % of y<sub>m</sub>'),
        ('latency y → v, median',
         NOTHING if latency is None else f'{latency["p50"]:.3g} ms'),
        ('latency y → v, 99th percentile',
         NOTHING if latency is None else f'{latency["p99"]:.3g} ms'),
        ('state at the end', escape(summary['final_status'] or NOTHING)),
        ('noise on y, learned / told', _number(summary['noise_ratio'], 3)),
        ('unexplained motion of u', NOTHING if unexplained is None or not isfinite(unexplained)
         else f'{100.0 * unexplained:.3g} % of m times the gap'),
        ('samples in state tracking',
         NOTHING if share is None else f'{100.0 * share["tracking"]:.3g} %'),
    ]
    rows = [(*facts[i], *facts[i + 1]) for i in range(0, len(facts), 2)]
    body = ''.join(f'<tr>{"".join(f"<td>{cell}</td>" for cell in row)}</tr>' for row in rows)
    return f'<table class="facts">{body}</table>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML."""
    head = ''.join(f'<th>{cell}</th>' for cell in header)
    body = ''.join(f'<tr>{"".join(f"<td>{cell}</td>" for cell in row)}</tr>' for row in rows)
    return f'<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


def _number(value: float | None, digits: int = 4) -> str:
    return NOTHING if value is None or value != value else f'{value:.{digits}g}'
