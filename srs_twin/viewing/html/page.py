"""Pages of HTML from templates; each is one file that needs nothing but a browser."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from srs_twin.comparison.metrics import VALIDATION
from srs_twin.io.files import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Table(NamedTuple):
    """A table of text, as the templates take it.

    Attributes:
        headings: one a column, with the unit.
        rows: cells, as text or `Markup`.
        numbers: indices of the columns set to the right.
        note: what a reader must know: what it does not show, how numbers compare.
        title: what it is of, where the page does not say so.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Collection[int] = ()
    note: str = ""
    title: str = ""


class Picture(NamedTuple):
    """A picture inside the page.

    Attributes:
        source: its content as a ``data:`` address.
        caption: what it shows.
    """

    source: str
    caption: str


def render(template: str, **content: Any) -> str:
    """Return a page; text is escaped, `Markup` is not.

    Args:
        template: path of the template below the package's folder.
        content: what the template names.
    """
    return _environment().get_template(template).render(content, validated=VALIDATION)


def piece(words: str, table: Table, shown: Picture | None = None) -> str:
    """Return a part of a page, as a notebook shows it: a line, a table, a picture."""
    parts: Any = _environment().get_template("viewing/html/parts.html").module
    pictures = parts.pictures([shown]) if shown else ""
    return str(Markup("<p><b>{}</b></p>{}{}").format(printable(words), parts.table(table), pictures))


@cache
def _environment() -> Environment:
    folder = FileSystemLoader(Path(__file__).parents[2])
    return Environment(
        loader=folder, autoescape=True, undefined=StrictUndefined, finalize=_clean, trim_blocks=True
    )


def _clean(value: Any) -> Any:
    # No control characters: HTML may not hold them, and a terminal that prints the file obeys them.
    return value if isinstance(value, Markup) else printable(str(value), keep="\t\n")


def colored(text: str, color: str) -> Markup:
    """Return text as a cell in a colour of the page: "met", "missed" or "sub"."""
    return Markup('<span class="{}">{}</span>').format(color, text)


def picture(figure: Figure, caption: str) -> Picture:
    """Return a figure as SVG; the same figure gives the same bytes."""
    # A page without pictures need not wait for it.
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return image(buffer.getvalue(), "svg+xml", caption)


def image(content: bytes, kind: str, caption: str) -> Picture:
    """Return a picture from its file's content, "svg+xml" or "png"."""
    return Picture(f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}", caption)


def cell(value: Any) -> str:
    """Return a JSON value for people; a dash where there is none."""
    match value:
        case None:
            return "–"
        case float():
            return f"{value:.4g}"
        case Mapping():
            return json.dumps(value, ensure_ascii=False)
        case list() | tuple():
            return ", ".join(
                f"[{cell(each)}]" if isinstance(each, list | tuple) else cell(each) for each in value
            )
    return str(value)
