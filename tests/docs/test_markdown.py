"""The site contains all text of a page: MyST drops no line that other Markdown programs show."""

from __future__ import annotations

import re
import runpy
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache

import pytest
from conftest import ROOT
from markdown_it import MarkdownIt
from markdown_it.renderer import RendererHTML
from markdown_it.token import Token
from myst_parser.config.main import MdParserConfig
from myst_parser.parsers.mdit import create_md_parser
from pages import PAGES

TARGET = re.compile(r"^\(([\w-]+)\)=$", re.M)
LINKED = {
    name for page in PAGES for name in re.findall(r"\]\([^)\s]*#([\w-]+)\)", page.text)
} | {
    name
    for path in ROOT.glob("scenarios/*.yaml")
    for name in re.findall(r"docs/[\w-]+\.md#([\w-]+)", path.read_text("utf-8"))
}


@cache
def myst() -> MarkdownIt:
    """Return the site's parser."""
    site = runpy.run_path(str(ROOT / "docs/conf.py"))
    names = ("enable_extensions", "dmath_double_inline", "heading_anchors")
    return create_md_parser(
        MdParserConfig(**{name: site[f"myst_{name}"] for name in names}), RendererHTML
    )


def contents(tokens: Iterable[Token]) -> Iterator[str]:
    for token in tokens:
        if token.children is not None:
            yield from contents(token.children)
        elif not token.type.startswith("myst_"):
            yield token.content
            yield token.info if token.type == "fence" else ""


def words(parser: MarkdownIt, text: str) -> Counter[str]:
    # Letters alone: parsers differ in the emphasis and the escapes that they see in
    # formulas.
    return Counter(re.findall(r"[^\W\d_]+", " ".join(contents(parser.parse(text, {})))))


def lost(text: str) -> list[str]:
    """Return the words and constructs of a page that the site does not show."""
    plain = MarkdownIt("commonmark").enable("table")
    env = {}
    tokens = plain.parse(text, env)
    open_comments = [
        token.content
        for token in tokens
        if token.content.count("<!--") > token.content.count("-->")
    ]
    shown = TARGET.sub(lambda found: "" if found[1] in LINKED else found[0], text)
    missing = words(plain, shown) - words(myst(), shown)
    breaks = [
        token.type
        for token in myst().parse(shown, {})
        if token.type.startswith(("myst_", "front_"))
    ]
    comments = [
        token.content
        for token in tokens
        if token.type == "html_block" and token.content in open_comments
    ]
    return [*missing.elements(), *breaks, *env.get("references", {}), *comments]


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_site_shows_every_word_of_a_page(page):
    assert lost(page.text) == []


@pytest.mark.parametrize(
    "dropped",
    [
        "wide by ±1.5\n% say nothing.",
        "- an item of\n  % of all\n  items",
        "one\n+++\ntwo",
        "one\n\n+++ more\n\ntwo",
        "one\n\n(an-aside)=\n\ntwo",
        "one\n\n[aside]: that",
        "one\n\n<!-- begin\n\ntwo",
        "a [span]{.wide} of text",
    ],
)
def test_a_construct_that_drops_text_is_found(dropped):
    assert lost(f"# Title\n\n{dropped}\n") != []


def test_code_and_formulas_are_not_dropped_text():
    text = (
        "# Title\n\n```\n% comment\n+++\n[a]: b\n```\n\n50 % of $x_i\\,y^*$ and\n\n$$"
        " a_i + \\frac{b}{c} $$\n"
    )
    assert lost(text) == []
