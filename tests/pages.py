"""The pages of the documentation as tests read them: blocks, commands, scripts."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from conftest import ROOT

PROGRAMS = ("srs-twin ", "uv ")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, what stands behind it (`runnable`, a file's name, …), its text."""

    language: str
    mark: str
    text: str

    @property
    def file(self) -> str | None:
        """The name under which a reader is told to save it."""
        return self.mark if re.fullmatch(r"[\w.-]+\.\w+", self.mark) else None


@dataclass(frozen=True)
class Page:
    """One page."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.relative_to(ROOT).as_posix()

    @cached_property
    def text(self) -> str:
        return self.path.read_text("utf-8")

    @cached_property
    def blocks(self) -> list[Block]:
        found = re.findall(r"^ *```([\w{}-]*) ?(.*)\n((?:.*\n)*?) *```$", self.text, re.M)
        return [Block(*each) for each in found]

    @cached_property
    def prose(self) -> str:
        """The page without its blocks."""
        return re.sub(r"^ *```.*\n(?:.*\n)*? *```$", "", self.text, flags=re.M)

    @property
    def anchors(self) -> set[str]:
        """Targets of links: headings, as forges and the site spell them, and labels such as ``(gains)=``."""
        headings = re.findall(r"^#+ (.*)$", self.prose, re.M)
        labels = re.findall(r"^\(([\w-]+)\)=$", self.prose, re.M)
        return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings} | {*labels}

    @property
    def commands(self) -> list[str]:
        """Every line that a reader is to type, without comments; blocks of no language may be output."""
        found = []
        for block in self.blocks:
            if block.language in ("", "sh"):
                joined = block.text.replace("\\\n", " ").splitlines()
                lines = [line.partition(" # ")[0].strip() for line in joined]
                found += [line for line in lines if line and (block.language or line.startswith(PROGRAMS))]
        return found

    @property
    def script(self) -> str:
        """All blocks of Python as the one script that a reader makes of them."""
        return "\n".join(block.text for block in self.blocks if block.language == "python")

    @property
    def mentions(self) -> list[str]:
        """Commands in the prose; they may lack what they need: `srs-twin compare --explain`."""
        found = re.findall(r"`((?:uv run )?(?:srs-twin [a-z-]|python benchmarks)[^`]*)`", self.prose)
        return [" ".join(each.split()) for each in found]

    @property
    def files(self) -> set[str]:
        """Names of files that the page has a reader save."""
        return {block.file for block in self.blocks if block.file}

    def save_files(self, folder: Path) -> None:
        """Save in a folder what a reader is told to save, beside what ships."""
        for name in ("scenarios", "calibration"):
            # Examples write beside what ships, so not links: that would be into the checkout.
            shutil.copytree(ROOT / name, folder / name)
        for block in self.blocks:
            if block.file:
                (folder / block.file).write_text(block.text, "utf-8")

    def run_script(self, folder: Path) -> str:
        """Run the Python of the page in a folder as a script of its own; return what it prints."""
        self.save_files(folder)
        (folder / "example.py").write_text(self.script, "utf-8")
        words = [sys.executable, "example.py"]
        paths = os.environ | {"PYTHONPATH": str(ROOT / "tests/helpers")}
        done = subprocess.run(words, cwd=folder, env=paths, capture_output=True, text=True, timeout=600)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        return done.stdout


def words_of(command: str) -> list[str]:
    """Return the words of a command; `…` stands for whatever a reader puts there and is left out."""
    return [word for word in shlex.split(command) if word != "…"]


PAGES = [
    Page(path)
    for path in sorted(
        [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "models/README.md",
         ROOT / "calibration/README.md", ROOT / "examples/firmware/README.md"]
    )
]  # fmt: skip
