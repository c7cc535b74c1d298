"""The site builds without warnings, detects broken links, and loads no external resources."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from conftest import ROOT
from pages import PAGES

import srs_twin
from srs_twin.cli.app import command
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.file import with_extensions
from srs_twin.studies.sweep.points import SweepFile

# Attributes that make a browser load a resource automatically; `href` only in these
# elements.
FETCHED = {"src", "srcset", "data", "poster", "action", "background"}
FETCHING = {"link", "base", "image", "use"}


def build(target, *, source=ROOT):
    """Run Sphinx as CONTRIBUTING.md says; warnings are errors."""
    sphinx = Path(sys.executable).with_name("sphinx-build")
    options = ["-W", "--keep-going", "-q", "-c", ROOT / "docs"]
    return subprocess.run(
        [sphinx, *options, source, target],
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    target = tmp_path_factory.mktemp("site")
    done = build(target)
    assert done.returncode == 0, done.stderr
    return target


class Fetches(HTMLParser):
    """Collects what a page makes a browser fetch, and the text of its tables' first cells."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        self.found += [
            value or ""
            for name, value in attrs
            if name in FETCHED or (name == "href" and tag in FETCHING)
        ]


def fetched(text):
    reader = Fetches()
    reader.feed(text)
    return reader.found + re.findall(r"url\(([^)]+)\)|@import\s+(\S+)", text)


def is_foreign(target):
    return bool(re.match(r"[\"']?(?:https?:)?//", "".join(target)))


@pytest.mark.slow
def test_site_loads_no_external_resources(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > len(PAGES)
    for path in [*pages, *site.rglob("*.css")]:
        foreign = [
            each for each in fetched(path.read_text("utf-8")) if is_foreign(each)
        ]
        assert foreign == [], path
    assert not [path for path in site.rglob("*") if "mathjax" in path.name.lower()]


def test_checker_finds_external_resources():
    page = """<link rel="stylesheet" href="//fonts.example/a.css"><script src='https://cdn.example/x.js'></script>
    <style>@import "http://a.example/b.css"; body { background: url(https://c.example/d.png) }</style>
    <a href="https://fine.example">a link</a> <img src="../_images/hero.png">"""
    assert len([each for each in fetched(page) if is_foreign(each)]) == 4


@pytest.mark.slow
def test_every_page_is_in_the_site(site):
    for page in PAGES:
        assert (site / page.name).with_suffix(".html").is_file(), page.name
    assert "docs/index.html" in (site / "index.html").read_text("utf-8")


@pytest.mark.slow
def test_formulas_need_no_scripts(site):
    shown = (site / "docs/planar-models.html").read_text("utf-8")
    formulas = re.findall(
        r"(?<!\w)\$\$",
        next(p for p in PAGES if p.name == "docs/planar-models.md").prose,
    )
    assert shown.count('<div class="math">') == len(formulas) / 2 > 5
    assert "$$" not in re.sub(r"<(pre|code).*?</\1>", "", shown, flags=re.S)


def keys_of(schema):
    """Every key of every block of a schema; those of records are not blocks."""
    blocks = [
        schema,
        *(
            each
            for name, each in schema["$defs"].items()
            if not name.startswith("Record")
        ),
    ]
    return {key for block in blocks for key in block.get("properties", {})}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "model"),
    [("scenario", with_extensions()), ("scenario", SweepFile), ("robot", RobotFile)],
)
def test_every_key_is_in_the_reference(site, page, model):
    shown = (site / f"docs/reference/{page}.html").read_text("utf-8")
    rows = re.findall(r"<tr class=\"row-\w+\"><td>(.*?)</tr>", shown, re.S)
    cells = [
        [re.sub(r"<[^>]+>", "", cell).strip() for cell in row.split("<td>")]
        for row in rows
    ]
    keys = {cell[0] for cell in cells}
    missing = keys_of(model.model_json_schema(by_alias=True)) - keys
    assert missing == set()
    assert [cell for cell in cells if len(cell) == 5 and not all(cell[2:])] == []


def commands_in(given, words=("srs-twin",)):
    inner = getattr(given, "commands", {})
    if not inner:
        yield " ".join(words), given
    for name, each in inner.items():
        yield from commands_in(each, (*words, name))


@pytest.mark.slow
def test_every_command_and_option_is_in_the_reference(site):
    shown = html.unescape(
        re.sub(
            r"<[^>]+>", "", (site / "docs/reference/commands.html").read_text("utf-8")
        )
    )
    _, *parts = re.split(r"\n(srs-twin[\w -]*)¶\n", shown)
    sections = dict(zip(parts[::2], parts[1::2], strict=True))
    for name, given in commands_in(command()):
        for each in given.params:
            assert (
                each.opts[-1] in sections[name] or each.param_type_name == "argument"
            ), (name, each.opts)
            assert not each.help or each.help[:20] in sections[name], (name, each.opts)


@pytest.mark.slow
def test_every_public_name_is_in_the_python_reference(site):
    text = next(page.text for page in PAGES if page.name == "docs/reference/api.md")
    named = re.findall(r"^\.\. auto\w+:: srs_twin\.(\w+)$", text, re.M)
    assert sorted(named) == sorted(set(srs_twin.__all__) - {"__version__"})
    shown = (site / "docs/reference/api.html").read_text("utf-8")
    assert all(f'id="srs_twin.{name}"' in shown for name in named)


@pytest.mark.slow
def test_a_broken_link_or_anchor_fails(tmp_path):
    for name in ("docs", "models", "calibration", "scenarios"):
        (tmp_path / name).mkdir()
    (tmp_path / "docs/index.md").write_text(
        "# A\n[gone](gone.md) [lost](#nowhere)\n[file](../scenarios/x.yaml)\n"
    )
    done = build(tmp_path / "site", source=tmp_path)
    assert done.returncode == 1
    assert {"gone.md", "nowhere", "../scenarios/x.yaml"} <= set(
        re.findall(r"'([^']+)'", done.stderr)
    ), done.stderr
