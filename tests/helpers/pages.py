"""Documentation pages as data for tests: blocks, commands, scripts."""

from __future__ import annotations

import re
import shlex
import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from conftest import ROOT
from processes import python

PROGRAMS = ("srs-twin ", "uv ")


@dataclass(frozen=True)
class Block:
    """Fenced block: language, mark after the language (`runnable`, a file name, …), and text."""

    language: str
    mark: str
    text: str

    @property
    def file(self) -> str | None:
        """Name of the file to save the block in, or None."""
        return self.mark if re.fullmatch(r"[\w.-]+\.\w+", self.mark) else None


@dataclass(frozen=True)
class Page:
    """Documentation page."""

    path: Path

    @property
    def name(self) -> str:
        return self.path.relative_to(ROOT).as_posix()

    @cached_property
    def text(self) -> str:
        return self.path.read_text("utf-8")

    @cached_property
    def blocks(self) -> list[Block]:
        blocks = re.findall(
            r"^ *```([\w{}-]*) ?(.*)\n((?:.*\n)*?) *```$", self.text, re.M
        )
        return [Block(*block) for block in blocks]

    @cached_property
    def prose(self) -> str:
        """Text of the page without its blocks."""
        return re.sub(r"^ *```.*\n(?:.*\n)*? *```$", "", self.text, flags=re.M)

    @property
    def anchors(self) -> set[str]:
        """Link targets: headings as GitHub and the site spell them, and labels such as ``(gains)=``."""
        headings = re.findall(r"^#+ (.*)$", self.prose, re.M)
        labels = re.findall(r"^\(([\w-]+)\)=$", self.prose, re.M)
        return {
            re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
            for heading in headings
        } | {*labels}

    @property
    def commands(self) -> list[str]:
        """Command lines without comments; blocks without a language may also be output."""
        commands = []
        for block in self.blocks:
            if block.language in ("", "sh"):
                joined = block.text.replace("\\\n", " ").splitlines()
                lines = [line.partition(" # ")[0].strip() for line in joined]
                commands += [
                    line
                    for line in lines
                    if line and (block.language or line.startswith(PROGRAMS))
                ]
        return commands

    @property
    def script(self) -> str:
        """All Python blocks of the page as one script."""
        return "\n".join(
            block.text for block in self.blocks if block.language == "python"
        )

    @property
    def mentions(self) -> list[str]:
        """Commands in the prose, possibly incomplete, such as `srs-twin compare --explain`."""
        commands = re.findall(
            r"`((?:uv run )?(?:srs-twin [a-z-]|python benchmarks)[^`]*)`", self.prose
        )
        return [" ".join(command.split()) for command in commands]

    @property
    def files(self) -> set[str]:
        """Names of the files that the page defines, or writes by `srs-twin new`."""
        written = re.findall(r"srs-twin new \w+ (\w+)", "\n".join(self.commands))
        defined = {block.file for block in self.blocks if block.file}
        return defined | {f"{name}.yaml" for name in written}

    def save_files(self, folder: Path) -> None:
        """Write the files of the page to a folder with copies of the shipped files."""
        for name in ("scenarios", "calibration"):
            # Copies instead of links, because examples write to these folders.
            shutil.copytree(ROOT / name, folder / name)
        for block in self.blocks:
            if block.file:
                (folder / block.file).write_text(block.text, "utf-8")

    def run_script(self, folder: Path) -> str:
        """Run the Python blocks of the page as a script in a folder, and return its output."""
        self.save_files(folder)
        (folder / "example.py").write_text(self.script, "utf-8")
        helpers = str(ROOT / "tests/helpers")
        done = python("example.py", cwd=folder, PYTHONPATH=helpers)
        assert done.stderr == ""
        return done.stdout


def words_of(command: str) -> list[str]:
    """Return the arguments of a command without the placeholder `…`."""
    return [word for word in shlex.split(command) if word != "…"]


PAGES = [
    Page(path)
    for path in sorted(
        [
            *ROOT.glob("*.md"),
            *(ROOT / "docs").rglob("*.md"),
            ROOT / "models/README.md",
            ROOT / "calibration/README.md",
            ROOT / "examples/firmware/README.md",
        ]
    )
]
