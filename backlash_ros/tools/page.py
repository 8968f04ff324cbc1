"""Self-contained HTML pages: no script, no font, no picture from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

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
.facts td { width: 25%; text-align: left; }
.facts td:nth-child(odd) { color: #555; }
.lead { color: #444; }
.warning { background: #fff4e0; border-left: 4px solid #E69F00; padding: 8px 12px; }
img { width: 100%; height: auto; display: block; }
pre { overflow-x: auto; font-size: 13px; background: #f6f6f4; padding: 12px; }
summary { cursor: pointer; font-weight: 600; }
"""


@dataclass(frozen=True)
class Picture:
    """A figure of a page: name of its PNG file, heading, what to see in it (HTML)."""

    name: str
    heading: str
    caption: str
    data: bytes


def page(
    title: str, lead: str, warnings: Sequence[str], parts: Sequence[str],
    pictures: Sequence[Picture], folded: tuple[str, str] | None = None,
) -> str:
    """A page as text.

    lead: the outcome in a sentence, HTML like the parts, which are sections between the warnings
    and the pictures. folded: heading and text of a last section that opens on a click.
    """
    sections = list(parts)
    for picture in pictures:
        heading, data = escape(picture.heading), base64.b64encode(picture.data).decode('ascii')
        sections.append(f'<h2>{heading}</h2>\n<p>{picture.caption}</p>\n'
                        f'<img alt="{heading}" src="data:image/png;base64,{data}">')
    if folded is not None:
        summary, text = map(escape, folded)
        sections.append(f'<details><summary>{summary}</summary><pre>{text}</pre></details>')
    return '\n'.join([
        '<!DOCTYPE html>', '<html lang="en">', '<head>', '<meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<title>{escape(title)}</title>', f'<style>{STYLE}</style>', '</head>', '<body>', '<main>',
        f'<h1>{escape(title)}</h1>', f'<p class="lead">{lead}</p>',
        *(f'<p class="warning">{escape(warning)}</p>' for warning in warnings),
        *(f'<section>\n{section}\n</section>' for section in sections),
        '</main>', '</body>', '</html>', '',
    ])


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML."""
    head = ''.join(f'<th>{cell}</th>' for cell in header)
    return f'<table><thead><tr>{head}</tr></thead><tbody>{_body(rows)}</tbody></table>'


def facts(pairs: Sequence[tuple[str, str]], columns: int = 2) -> str:
    """A table of names and values, so many pairs in a row; the cells are HTML."""
    rows = [sum(pairs[i:i + columns], ()) for i in range(0, len(pairs), columns)]
    return f'<table class="facts">{_body(rows)}</table>'


def _body(rows: Sequence[Sequence[str]]) -> str:
    return ''.join(f'<tr>{"".join(f"<td>{cell}</td>" for cell in row)}</tr>' for row in rows)
