"""Self-contained HTML pages rendered from templates."""

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
from srs_twin.io.files import escape_unprintable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Table(NamedTuple):
    """Table in an HTML page.

    Attributes:
        numbers: indices of right-aligned columns.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Collection[int] = ()
    note: str = ""
    title: str = ""


class Picture(NamedTuple):
    """Image embedded in a page as a ``data:`` URL."""

    source: str
    caption: str


def render(template: str, **content: object) -> str:
    """Render an HTML template of this package.

    Strings in `content` are HTML-escaped, and `Markup` objects are inserted unchanged.
    """
    return _environment().get_template(template).render(content, validated=VALIDATION)


def notebook_output(summary: str, table: Table, plot: Picture | None = None) -> str:
    """Return a summary, a table and a plot as HTML for a notebook cell."""
    macros: Any = _environment().get_template("viewing/html/parts.html").module
    pictures = macros.pictures([plot]) if plot else ""
    return str(
        Markup("<p><b>{}</b></p>{}{}").format(
            escape_unprintable(summary), macros.table(table), pictures
        )
    )


@cache
def _environment() -> Environment:
    folder = FileSystemLoader(Path(__file__).parents[2])
    return Environment(
        loader=folder,
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_clean,
        trim_blocks=True,
    )


def _clean(value: object) -> object:
    # HTML does not allow control characters, and a terminal that shows the file would
    # interpret them as commands.
    if isinstance(value, Markup):
        return value
    return escape_unprintable(str(value), keep="\t\n")


def colored(text: str, color: str) -> Markup:
    """Return text in an element with the CSS class "met", "missed" or "sub"."""
    return Markup('<span class="{}">{}</span>').format(color, text)


def picture(figure: Figure, caption: str) -> Picture:
    """Convert a figure to an embedded SVG image."""
    # Pages without figures do not need this slow import.
    from srs_twin.viewing.plots.style import own_settings

    buffer = io.BytesIO()
    with own_settings():
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return image(buffer.getvalue(), "svg+xml", caption)


def image(content: bytes, kind: str, caption: str) -> Picture:
    """Return a picture with embedded image data of kind "svg+xml" or "png"."""
    return Picture(
        f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}", caption
    )


def cell(value: object) -> str:
    """Format a JSON value for a table cell, with a dash for None."""
    match value:
        case None:
            return "–"
        case float():
            return f"{value:.4g}"
        case Mapping():
            return json.dumps(value, ensure_ascii=False)
        case list() | tuple():
            return ", ".join(
                f"[{cell(item)}]" if isinstance(item, list | tuple) else cell(item)
                for item in value
            )
    return str(value)
