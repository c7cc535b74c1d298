"""Just enough HTML: elements that escape whatever is not markup already, and the page around them."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal

from srs_twin.io.files import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_STYLE = """
:root { color-scheme: light dark; --line: #d0d4da; --soft: #5b6470; --card: #f5f6f8;
  --good: #00664b; --bad: #a33b00; }
@media (prefers-color-scheme: dark) {
  :root { --line: #3d434c; --soft: #a3acb8; --card: #1d2126; --good: #4fd1a5; --bad: #ff9a57; }
  body { background: #14171a; color: #e6e8eb; }
}
body { font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: 0; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
.sub, figcaption { color: var(--soft); } figure { margin: 1.2rem 0; }
figure img { width: 100%; background: white; border-radius: 6px; border: 1px solid var(--line); }
body.broad { max-width: 96rem; } .broad figure { max-width: 58rem; }
.broad td.number:nth-child(even) { white-space: nowrap; } .broad td:nth-child(2) { min-width: 17rem; }
.broad td:last-child { min-width: 19rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; }
th, td { text-align: left; padding: 0.3rem 0.7rem; vertical-align: top;
  border-bottom: 1px solid var(--line); }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
.met { color: var(--good); font-weight: 600; } .missed { color: var(--bad); font-weight: 600; }
details { background: var(--card); border-radius: 6px; padding: 0.6rem 1rem; margin: 0.8rem 0; }
summary { cursor: pointer; font-weight: 600; }
@media print { body { max-width: none; } details, figure, tr { break-inside: avoid; }
  .wide { overflow: visible; } table { font-size: 0.75rem; } th, td { padding: 0.15rem 0.35rem; } }
"""

# The page needs no script and nothing from outside; a browser that knows it will also refuse any.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


class Markup(str):
    """Text that is HTML already."""


def element(tag: str, *content: str, cls: str = "") -> Markup:
    """Return one element; content that is no `Markup` is escaped."""
    inner = "".join(part if isinstance(part, Markup) else _escaped(part) for part in content)
    attribute = f' class="{_escaped(cls)}"' if cls else ""
    return Markup(f"<{tag}{attribute}>{inner}</{tag}>")


def _escaped(text: str) -> str:
    # No control characters: HTML may not hold them, and a terminal that prints the file obeys them.
    return html.escape(printable(text, keep="\t\n"))


def table(headings: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()) -> Markup:
    """Return a table that scrolls sideways when it is too wide.

    Args:
        headings: one a column.
        rows: cells, as text or `Markup`.
        numbers: indices of the columns set to the right.
    """
    right = set(numbers)

    def line(tag: str, cells: Sequence[str]) -> Markup:
        made = (element(tag, cell, cls="number" if i in right else "") for i, cell in enumerate(cells))
        return element("tr", *made)

    head = element("thead", line("th", headings))
    body = element("tbody", *(line("td", row) for row in rows))
    return element("div", element("table", head, body), cls="wide")


def picture(figure: Figure, caption: str) -> Markup:
    """Return a figure as SVG inside the page; the same figure gives the same bytes."""
    # A page without pictures need not wait for it.
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return image(buffer.getvalue(), "svg+xml", caption)


def image(content: bytes, kind: Literal["svg+xml", "png"], caption: str) -> Markup:
    """Return what a file of a picture holds, inside the page."""
    data = base64.b64encode(content).decode("ascii")
    shown = Markup(f'<img alt="{_escaped(caption)}" src="data:image/{kind};base64,{data}">')
    return element("figure", shown, element("figcaption", caption))


def folded(title: str, *content: Markup) -> Markup:
    """Return content that shows when its title is opened."""
    return element("details", element("summary", title), *content)


def page(title: str, *content: Markup, broad: bool = False) -> str:
    """Return a whole, self-contained page, light or dark as the reader's system is.

    Args:
        title: of the window.
        content: of the page.
        broad: for tables with sentences in their second and last columns.
    """
    body = '<body class="broad">' if broad else "<body>"
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta http-equiv="Content-Security-Policy" content="{_escaped(_POLICY)}">'
        f"<title>{_escaped(title)}</title><style>{_STYLE}</style>"
    )
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n{body}{"".join(content)}</body></html>\n'
