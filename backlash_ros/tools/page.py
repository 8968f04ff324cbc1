"""Write self-contained HTML pages, which load no script, font or picture from elsewhere."""

import base64
from collections.abc import Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import NamedTuple

from backlash_ros.atomic_file import write_atomically


class Picture(NamedTuple):
    """A figure on a page: name of its PNG file, heading, caption (HTML), content of the file."""

    name: str
    heading: str
    caption: str
    data: bytes


def write_page(
    path: Path, title: str, lead: str, warnings: Sequence[str], parts: Sequence[str],
    pictures: Sequence[Picture], folded: tuple[str, str] | None = None,
) -> None:
    """Write a page with its pictures, and the pictures as files beside it as well.

    lead, parts: HTML. folded: heading and text of a last section, which is closed at first.
    """
    sections = list(parts)
    for file, name, caption, data in pictures:
        write_atomically(path.with_name(file), data)
        heading, coded = escape(name), base64.b64encode(data).decode('ascii')
        sections.append(f'<h2>{heading}</h2>\n<p>{caption}</p>\n'
                        f'<img alt="{heading}" src="data:image/png;base64,{coded}">')
    if folded is not None:
        summary, text = map(escape, folded)
        sections.append(f'<details><summary>{summary}</summary><pre>{text}</pre></details>')
    template = Template(Path(__file__).with_suffix('.html').read_text(encoding='utf-8'))
    write_atomically(path, template.substitute(title=escape(title), lead=lead, content='\n'.join([
        *(f'<p class="warning">{escape(warning)}</p>' for warning in warnings),
        *(f'<section>\n{section}\n</section>' for section in sections)])))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An HTML table of HTML cells; without a header, its rows are names and values."""
    lines = [''.join(f'<th>{cell}</th>' for cell in header),
             *(''.join(f'<td>{cell}</td>' for cell in row) for row in rows)]
    kind = 'values' if header else 'facts'
    return f'<table class="{kind}">{"".join(f"<tr>{line}</tr>" for line in lines if line)}</table>'
