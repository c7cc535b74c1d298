"""paper/: its numbers are those of the documentation, and its sources, figures and authors agree."""

import re
import tomllib

import pytest
import yaml
from conftest import ROOT

PAPER = (ROOT / "paper/paper.md").read_text("utf-8")
_, HEADER, BODY = PAPER.split("---\n", 2)
NUMBERS = [
    ("−2.1 to +2.6 % in speed and by at most 6.9 %", "verification"),
    ("within 0.6 % for 19 combinations", "verification"),
    ("within 1.2 % for a snake with a tail", "verification"),
    ("differs by −18 to +7.5 %", "verification"),
    ("of the twin by 0.6 % only", "verification"),
    ("raise it by 39 %", "verification"),
    ("crawls at 183 mm/s", "verification"),
    ("224 mm/s; the published speed is 214 mm/s", "verification"),
    ("16 to 22 % slower", "planar-models"),
    ("5 to 41 % slower", "planar-models"),
    ("169 statements", "reproduction"),
]


def one_line(text):
    return re.sub(r"\s+", " ", text)


@pytest.mark.parametrize(("phrase", "page"), NUMBERS)
def test_numbers_are_those_of_the_documentation(phrase, page):
    assert phrase in one_line(BODY)
    text = (ROOT / f"docs/{page}.md").read_text("utf-8")
    for number in re.findall(r"\d+(?:\.\d+)?", phrase):
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d]|\.\d)", text), number


def test_every_source_is_cited_and_every_citation_has_a_source():
    text = (ROOT / "paper/paper.bib").read_text("utf-8")
    sources = re.findall(r"^@\w+\{(\w+),$", text, re.M)
    cited = re.findall(r"@(\w+)", BODY)
    assert len(sources) == len(set(sources)) > 4
    assert set(cited) == set(sources)


def test_both_figures_exist_and_are_made_by_the_command():
    figures = re.findall(r"\]\((\w+\.png)\)", BODY)
    script = (ROOT / "paper/figures.py").read_text("utf-8")
    assert len(figures) == 2
    for figure in figures:
        assert (ROOT / "paper" / figure).read_bytes().startswith(b"\x89PNG")
        assert f'"{figure}"' in script


def test_authors_and_version_agree():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    (author,) = yaml.safe_load(HEADER)["authors"]
    names = [entry["name"] for entry in citation["authors"]]
    assert names == [author["name"]] == [entry["name"] for entry in project["authors"]]
    assert citation["version"] == project["version"]
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert re.search(
        rf"^## \[{re.escape(project['version'])}\] - \d{{4}}-", changes, re.M
    )
