"""Sentences that are probably not plain technical English.

    uv run python tests/helpers/language.py                  # share of suspicious sentences by room
    uv run python tests/helpers/language.py PATH…            # the sentences themselves

Reads docstrings, comments and help texts of Python files and the prose of Markdown
pages. A hit is a place to look at: rewrite the sentence instead of swapping the word.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]

_COUNTED = (
    "segment|run|connector|tick|step|second|module|kind|robot|wheel|row|file|chamber|period|"
    "sample|frame|plant"
)
PATTERNS = {
    "clause as subject": r"^What (?!is\?|are\?)",
    "verb + what": (
        r"\b(return|say|take|give|write|show|know|find|yield|hold|read|add)s? what\b"
    ),
    "whoever": r"\b(whoever|whatever|nobody|somebody|anybody|anyhow|anew)\b",
    "tell": r"\b(told|tells|tell of|telling of|untold)\b",
    "go": r"\b(goes by|goes on|go on|goes|went)\b",
    "stand, lie": r"\b(stands?|stood|lies|lain)\b",
    "beside": r"\bbesides?\b",
    "of its own": r"\bof (its|their|our|one's) own\b",
    "off": r"\b(is|are|was|were|be) off\b|\boff by\b",
    "as X has it": r"\bas [\w ]{1,25} ha(s|ve) (it|them)\b",
    "so many": r"\b(for|by|of) so (long|many|much|far)\b",
    "at the least": r"\bat the (least|most)\b",
    "by which": r"\b(by how much|by which|at which to|from which it)\b",
    "a Y for per Y": rf"\b\w+s an? ({_COUNTED})\b",
    "held against": r"\bh[eo]lds? against\b",
    "way": r"\bways?\b(?! to| of)",
    "others": r"\bthe others\b",
    "old words": r"\b(mend|mended|foretold|thereby|wherein|thereof|whereby|save for)\b",
    "on the air": r"\bon the air\b",
    "let": r"\blets?\b (?!us|you|δ|\$|X\b)",
    "say whether": r"^(Say|Tell|See) (whether|that|what)\b",
    "the text": r"\bthe text(?:'s)?\b",
}
_COMPILED = {
    name: re.compile(p, 0 if p.startswith("^") else re.IGNORECASE)
    for name, p in PATTERNS.items()
}


class Hit(NamedTuple):
    """A suspicious sentence.

    Attributes:
        path: of the file.
        line: where its block begins.
        sentence: with code and formulas as X.
        patterns: that it matches.
    """

    path: Path
    line: int
    sentence: str
    patterns: list[str]


def sentences(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the line and text of each sentence; code and formulas are replaced by X."""
    for line, block in (_python if path.suffix == ".py" else _markdown)(
        path.read_text("utf-8")
    ):
        for sentence in re.split(r"(?<=[.:;?!])\s|\n\s*\n", block):
            text = " ".join(
                re.sub(r"``[^`]*``|`[^`]*`|\$[^$]*\$", "X", sentence).split()
            )
            if len(re.findall(r"[A-Za-z]{2,}", text)) > 2:
                yield line, text


def hits(path: Path) -> list[Hit]:
    """Return the suspicious sentences of a file."""
    found = []
    for line, text in sentences(path):
        names = [name for name, pattern in _COMPILED.items() if pattern.search(text)]
        if names:
            found.append(Hit(path, line, text, names))
    return found


def share(paths: list[Path]) -> float:
    """Return the share of suspicious sentences in some files."""
    total = sum(sum(1 for _ in sentences(path)) for path in paths)
    return sum(len(hits(path)) for path in paths) / max(total, 1)


def rooms() -> dict[str, list[Path]]:
    """Return the files of each room of the package, of the pages, the tests and the benchmarks."""
    package = ROOT / "srs_twin"
    found: dict[str, list[Path]] = {}
    for path in sorted(package.rglob("*.py")):
        found.setdefault(path.relative_to(package).with_suffix("").parts[0], []).append(
            path
        )
    found["docs"] = [
        *sorted((ROOT / "docs").rglob("*.md")),
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
    ]
    found["changelog"] = [ROOT / "CHANGELOG.md"]
    for folder in ("tests", "benchmarks", "examples"):
        found[folder] = sorted((ROOT / folder).rglob("*.py"))
    return found


def _python(text: str) -> Iterator[tuple[int, str]]:
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        for child in body if isinstance(body, list) else ():
            value = child.value if isinstance(child, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                yield (
                    value.lineno,
                    re.sub(r"\$\$.*?\$\$", "", value.value, flags=re.DOTALL),
                )
        if isinstance(node, ast.Call):
            for keyword in node.keywords:
                value = keyword.value
                if (
                    keyword.arg == "help"
                    and isinstance(value, ast.Constant)
                    and isinstance(value.value, str)
                ):
                    yield value.lineno, value.value
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and not token.string.startswith(
            ("# type:", "# noqa", "# fmt")
        ):
            yield token.start[0], token.string.lstrip("#: ")


def _markdown(text: str) -> Iterator[tuple[int, str]]:
    kept = []
    fenced = False
    for line in re.sub(r"\$\$.*?\$\$", "", text, flags=re.DOTALL).splitlines():
        fenced ^= line.lstrip().startswith("```")
        skipped = fenced or line.lstrip().startswith(("|", "```", "#", "<", "("))
        kept.append("" if skipped else re.sub(r"\]\([^)]*\)", "]", line))
    yield 1, "\n".join(kept)


def main() -> None:
    """Print the suspicious sentences of files, or the shares by room."""
    if len(sys.argv) == 1:
        for room, paths in rooms().items():
            print(f"{100 * share(paths):5.1f} %  {room}")
        return
    for name in sys.argv[1:]:
        place = Path(name)
        for path in (
            sorted([*place.rglob("*.py"), *place.rglob("*.md")])
            if place.is_dir()
            else [place]
        ):
            for hit in hits(path):
                print(
                    f"{path}:{hit.line}: {hit.sentence}   [{', '.join(hit.patterns)}]"
                )


if __name__ == "__main__":
    main()
