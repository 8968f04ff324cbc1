"""Self-contained HTML pages: no script, no font, no picture from elsewhere."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import NamedTuple


class Picture(NamedTuple):
    """A figure of a page: name of its PNG file, heading, what to see in it (HTML)."""

    name: str
    heading: str
    caption: str
    data: bytes


def page(
    title: str, lead: str, warnings: Sequence[str], parts: Sequence[str],
    pictures: Sequence[Picture], folded: tuple[str, str] | None = None,
) -> str:
    """A page as text; lead and parts are HTML.

    folded: heading and text of a last section that opens on a click.
    """
    sections = list(parts)
    for _, name, caption, data in pictures:
        heading, coded = escape(name), base64.b64encode(data).decode('ascii')
        sections.append(f'<h2>{heading}</h2>\n<p>{caption}</p>\n'
                        f'<img alt="{heading}" src="data:image/png;base64,{coded}">')
    if folded is not None:
        summary, text = map(escape, folded)
        sections.append(f'<details><summary>{summary}</summary><pre>{text}</pre></details>')
    template = Template(Path(__file__).with_suffix('.html').read_text(encoding='utf-8'))
    return template.substitute(title=escape(title), lead=lead, content='\n'.join([
        *(f'<p class="warning">{escape(warning)}</p>' for warning in warnings),
        *(f'<section>\n{section}\n</section>' for section in sections),
    ]))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = ''.join(f'<th>{cell}</th>' for cell in header)
    return f'<table><thead><tr>{head}</tr></thead><tbody>{_body(rows)}</tbody></table>'


def facts(pairs: Sequence[tuple[str, str]], columns: int = 2) -> str:
    """A table of names and values, so many pairs in a row; the cells are HTML."""
    rows = [sum(pairs[i:i + columns], ()) for i in range(0, len(pairs), columns)]
    return f'<table class="facts">{_body(rows)}</table>'


def _body(rows: Sequence[Sequence[str]]) -> str:
    return ''.join(f'<tr>{"".join(f"<td>{cell}</td>" for cell in row)}</tr>' for row in rows)
