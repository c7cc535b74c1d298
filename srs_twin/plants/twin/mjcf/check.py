"""Check MJCF and URDF from anybody: scanned first, then compiled in a child process with limits.

A hundred bytes of ``<replicate>`` keep MuJoCo's compiler busy for minutes, and its parser opens whatever path
a file names. So the XML is read here first, element by element: no document types (entities), bounded depth,
size and number of what it multiplies to, and paths that stay in the model's folder or its parent (many
packages have ``urdf/`` next to ``meshes/``).

What passes the scan is compiled in a child with limits on time and memory, for MuJoCo accepts time steps of
NaN and negative friction as well. What passes that opens in any MuJoCo program and stands a second of random
control without a warning.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from srs_twin.io.files import require_file

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
MAX_FILE_BYTES = 4 << 20
MAX_ASSET_BYTES = 32 << 20
MAX_DEPTH = 400
MAX_ELEMENTS = 10_000
MAX_BODIES = 1_000
MAX_NESTED_FILES = 30
MAX_FOLDERS = 16
MAX_CELLS = 1 << 24
"""Pixels of all textures and points of all height fields together."""

_CELLS = "pixels of textures and points of height fields"
_COUNT_LIMITS = {"elements": MAX_ELEMENTS, "bodies": MAX_BODIES, _CELLS: MAX_CELLS}
_SIZE_LIMITS = {"memory": 1 << 30, "nstack": 1 << 27, "njmax": 1 << 20, "nconmax": 1 << 20, "nkey": 10_000}
_OTHER_SIZE_LIMIT = 1_000
_FOLDERS = ("assetdir", "meshdir", "texturedir")
_UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40, "P": 1 << 50, "E": 1 << 60}
_PNG = b"\x89PNG\r\n\x1a\n"


class _Refused(Exception):  # noqa: N818
    """Nothing further is to be read."""


@dataclass
class _Scan:
    """Findings and paths of one model: the main file, or one that it attaches.

    Attributes:
        main: the file that is checked, resolved.
        root: the model's own file.
        folders: in which assets may be looked up.
        strips: whether MuJoCo may look up assets by file name alone (``strippath``).
        assets: files that are not MJCF: place and element, path as given, folder of the file that names it.
        seen: files that were included.
        faults: found so far, for all models.
        models: what each attachable model multiplies to; None while it is being read.
        bytes: size of all XML and of all assets together, for all models.
    """

    main: Path
    root: Path
    folders: set[str] = field(default_factory=lambda: {"."})
    strips: bool = False
    assets: list[tuple[str, str, Path]] = field(default_factory=list)
    seen: set[Path] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)
    models: dict[Path, Counter[str] | None] = field(default_factory=dict)
    bytes: Counter[str] = field(default_factory=Counter)

    def existing(self, what: str, paths: Iterable[Path]) -> list[Path] | None:
        """Return those of some possible paths that exist, or None after noting that they lie outside.

        Args:
            what: the place and the name, for the message.
            paths: all that MuJoCo may open for one name.
        """
        # MuJoCo takes a backslash for a slash, and drops `..` from the text, whatever is linked where.
        reduced = {Path(os.path.normpath(str(path).replace("\\", "/"))): None for path in paths}
        found = [path for path in reduced if os.path.lexists(path)]
        allowed = _allowed_folder(self.main)
        outside = any(not Path(os.path.realpath(path)).is_relative_to(allowed) for path in found)
        if outside or not any(path.is_relative_to(allowed) for path in reduced):
            self.faults.append(f"{what}, outside the model's folder; files in {allowed} are allowed")
            return None
        return found


def _allowed_folder(main: Path) -> Path:
    """Return the parent of the model's folder, or the folder itself where the parent is not the project's."""
    folder = main.parent
    at_home = folder == Path(os.path.realpath(os.path.expanduser("~")))
    return folder if at_home or folder.parent == Path(folder.anchor) else folder.parent


def scan_mjcf(path: Path) -> list[str]:
    """Return what is wrong with an MJCF or URDF file, and what it refers to, before anything is compiled.

    Args:
        path: the file, resolved; whatever it names has to lie in its folder or the parent of that.

    Returns:
        One line a fault, with the line of the file in which it stands.
    """
    scan = _Scan(path, path, models={path: None})
    try:
        _Reader(scan, path, Counter(), 0).read()
        _check_assets(scan)
    except _Refused as fault:
        scan.faults.append(str(fault))
    return scan.faults


class _Reader:
    """Reads one file, element by element."""

    def __init__(self, scan: _Scan, path: Path, count: Counter[str], depth: int) -> None:
        self._scan, self._path, self._count, self._depth = scan, path, count, depth
        self._times = [1]
        self._models: list[Counter[str]] = []
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = lambda _: self._times.pop()
        no_doctype = "a document type (<!DOCTYPE>) is not allowed; MJCF needs no entities"
        self._parser.StartDoctypeDeclHandler = lambda *_: self._refuse(no_doctype)

    def read(self) -> None:
        """Take the whole file.

        Raises:
            _Refused: it is no XML, or beyond a bound.
        """
        try:
            self._scan.bytes["XML"] += self._path.stat().st_size
            if self._scan.bytes["XML"] > MAX_FILE_BYTES:
                raise _Refused(f"over {MAX_FILE_BYTES >> 20} MB of XML")
            self._parser.Parse(self._path.read_bytes(), True)
        except expat.ExpatError as error:
            self._refuse(f"not readable as XML ({expat.ErrorString(error.code)})", error.lineno)
        except (OSError, LookupError, ValueError) as error:
            # LookupError, ValueError: an encoding that does not exist, or has no place in XML.
            self._refuse(f"not readable as XML ({error})")
        for model in self._models:
            for what in ("elements", "bodies"):
                self._count[what] += self._count["attached"] * model[what]
        self._check_count()

    def _start(self, tag: str, attributes: Mapping[str, str]) -> None:
        times, count = self._times[-1], self._count
        if tag in ("replicate", "composite", "flexcomp"):
            made = times * _product(attributes.get("count", "1"))
            count["elements"] += made
            if tag == "replicate":
                times = made
            else:
                count["bodies"] += made
        self._times.append(times)
        count["elements"] += times
        count["bodies"] += times * (tag == "body")
        count["attached"] += times * (tag == "attach")
        count[_CELLS] += _cells(attributes, "width", "height") + _cells(attributes, "nrow", "ncol")
        self._check_count()
        if len(self._times) > MAX_DEPTH:
            self._refuse(f"nested more than {MAX_DEPTH} deep")
        for name, value in attributes.items():
            most = _SIZE_LIMITS.get(name, _OTHER_SIZE_LIMIT)
            if tag == "size" and _bytes(value) > most:
                self._refuse(f"<size> asks for {name} {value}; at most {most} is allowed")
            self._scan.strips |= name == "strippath" and value != "false"
            if name in _FOLDERS:
                folder = [self._scan.root.parent / value]
                if self._scan.existing(self._names(tag, value), folder) is not None:
                    self._scan.folders.add(value)
                if len(self._scan.folders) > MAX_FOLDERS:
                    self._refuse(f"more than {MAX_FOLDERS} folders of assets")
            elif name.startswith("file"):
                self._refer(tag, value)

    def _check_count(self) -> None:
        for what, most in _COUNT_LIMITS.items():
            if self._count[what] > most:
                self._refuse(f"more than {most} {what}, counting what is replicated")

    def _names(self, tag: str, given: str) -> str:
        return f"{self._place()}: <{tag}> names '{given}'"

    def _refer(self, tag: str, given: str) -> None:
        what, near = self._names(tag, given), self._path.parent
        if tag not in ("include", "model"):
            self._scan.assets.append((what, given, near))
            return
        # MuJoCo looks in the folder of the model, then in that of the file.
        found = self._scan.existing(what, [self._scan.root.parent / given, near / given])
        if found == [] or not all(map(os.path.isfile, found or [])):
            raise _Refused(f"{what}, which is not a file")
        if self._depth == MAX_NESTED_FILES:
            raise _Refused(f"{what}; files nested more than {MAX_NESTED_FILES} deep are not allowed")
        for target in found or []:
            if tag == "model":
                self._models.append(self._model(what, target))
            elif target not in self._scan.seen:
                self._scan.seen.add(target)
                _Reader(self._scan, target, self._count, self._depth + 1).read()

    def _model(self, what: str, target: Path) -> Counter[str]:
        """Return what an attachable model multiplies to, read once."""
        scan, models = self._scan, self._scan.models
        if target not in models:
            models[target] = None
            count: Counter[str] = Counter()
            own = replace(scan, root=target, folders={"."}, strips=False, assets=[], seen=set())
            _Reader(own, target, count, self._depth + 1).read()
            _check_assets(own)
            models[target] = count
        found = models[target]
        if found is None:
            raise _Refused(f"{what}, which is a part of itself")
        return found

    def _refuse(self, fault: str, line: int | None = None) -> NoReturn:
        raise _Refused(f"{self._place(line)}: {fault}")

    def _place(self, line: int | None = None) -> str:
        number = line or self._parser.CurrentLineNumber
        here = self._path == self._scan.main
        return f"line {number}" if here else f"{self._path.name}:{number}"


def _check_assets(scan: _Scan) -> None:
    """Refuse files that MuJoCo would open but are none, lie elsewhere, or are too large."""
    for what, given, near in scan.assets:
        names = {given, Path(given.replace("\\", "/")).name if scan.strips else given}
        bases = [scan.root.parent / folder for folder in sorted(scan.folders)] + [near]
        for path in scan.existing(what, [base / name for base in bases for name in names]) or []:
            if not path.is_file():
                raise _Refused(f"{what}, which is not a file")
            scan.bytes["assets"] += path.stat().st_size
            if scan.bytes["assets"] > MAX_ASSET_BYTES:
                raise _Refused(f"{what}, which brings the assets above {MAX_ASSET_BYTES >> 20} MB")
            if _png_pixels(path) > MAX_CELLS:
                raise _Refused(f"{what}, a picture of more than {MAX_CELLS} pixels")


def _png_pixels(path: Path) -> int:
    with path.open("rb") as stream:
        head = stream.read(24)
    return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24]) if head.startswith(_PNG) else 0


def _numbers(text: str) -> list[float]:
    """Return the finite numbers of a text; what is none, MuJoCo will say."""
    found = []
    for word in text.split():
        try:
            number = float(word)
        except ValueError:
            continue
        found.append(number if math.isfinite(number) else 1e18)
    return found


def _product(text: str) -> int:
    """Return what numbers such as '10 10 1' multiply to, at least 1 and not beyond all bounds."""
    product = 1.0
    for number in _numbers(text):
        product = min(product * max(1.0, number), 1e18)
    return int(product)


def _cells(attributes: Mapping[str, str], rows: str, columns: str) -> int:
    # What is missing is 0 to MuJoCo: nothing is made then.
    if not {rows, columns} <= attributes.keys():
        return 0
    return _product(attributes[rows]) * _product(attributes[columns])


def _bytes(text: str) -> float:
    """Return a size such as '100', '-1' or '2G'."""
    unit = _UNITS.get(text.strip()[-1:].upper(), 1)
    return unit * max(_numbers(text.strip().rstrip("KMGTPEkmgtpe")), default=0.0)


TIME_LIMIT_S = 30
MEMORY_LIMIT_BYTES = 4 << 30
CONTROL_S = 1.0
TIMESTEPS_S = (1e-5, 0.1)
MAX_ITERATIONS = 10_000
_REDRAW_S = 0.02
_PATIENCE_S = 0.5  # of random control, until it is judged how long it will take
_ITERATIONS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations")
_NOT_NEGATIVE = ("geom_friction", "pair_friction", "dof_damping", "dof_frictionloss", "body_mass")


@dataclass(frozen=True)
class ModelReport:
    """What a check found.

    Attributes:
        faults: one line each; empty where the model is fit for use.
        sizes: what the compiled model has: bodies, joints, actuators, mass_kg, timestep_s.
        notes: one line each; what MuJoCo makes of the file without a word.
    """

    faults: tuple[str, ...]
    sizes: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def check_mjcf(path: Path, *, time_limit_s: int = TIME_LIMIT_S) -> ModelReport:
    """Compile a model in a child process and give it a second of random control.

    Args:
        path: the MJCF or URDF file.
        time_limit_s: most that the child may take, s.

    Raises:
        InputError: there is no such file.
    """
    remedy = "; give an MJCF or URDF file, or the name of a shipped robot"
    suffix = path.suffix if path.suffix in MODEL_SUFFIXES else ".xml"
    model = require_file(path, suffix=suffix, remedy=remedy).resolve()
    faults = scan_mjcf(model)
    if faults:
        return ModelReport(tuple(faults))
    command = [sys.executable, "-m", "srs_twin.plants.twin.mjcf.check", str(model), str(time_limit_s)]
    # No window system is needed, and threads of numpy's would count as memory.
    env = {**os.environ, "MUJOCO_GL": "disabled", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryDirectory() as room:  # MuJoCo leaves its log file where it runs
        try:
            child = subprocess.run(
                command, cwd=room, env=env, capture_output=True, text=True, timeout=time_limit_s
            )
        except subprocess.TimeoutExpired:
            return ModelReport((f"did not finish within {time_limit_s} s",))
    said = child.stderr.strip().splitlines()
    return verdict(child.stdout, said[-1] if said else f"exit status {child.returncode}", time_limit_s)


def verdict(found: str, ending: str, time_limit_s: int) -> ModelReport:
    """Return what a child found, or that it broke.

    Args:
        found: what it wrote.
        ending: its last words, or how it ended.
        time_limit_s: most that it might take, s.
    """
    try:
        report = json.loads(found)
    except ValueError:
        limits = f"{MEMORY_LIMIT_BYTES >> 30} GB, {time_limit_s} s"
        return ModelReport((f"broke MuJoCo or a limit ({limits}): {ending}",))
    return ModelReport(tuple(report["faults"]), report["sizes"], tuple(report["notes"]))


def _bad_numbers(model: Any) -> list[str]:
    """Return a fault for each number that MuJoCo compiles but no body can have."""
    faults = []
    low, high = TIMESTEPS_S
    if not low <= model.opt.timestep <= high:
        faults.append(f"timestep {model.opt.timestep:g} s is not allowed; it must be {low:g} to {high:g} s")
    for name in _ITERATIONS:
        if getattr(model.opt, name) > MAX_ITERATIONS:
            faults.append(f"{name} {getattr(model.opt, name)} are not allowed; at most {MAX_ITERATIONS}")
    for name in _NOT_NEGATIVE:
        values = getattr(model, name)
        if (values < 0).any():
            faults.append(f"{name}{_first(values < 0)} has a negative value")
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            faults.append(f"{name}{_first(~np.isfinite(value))} has a value that is not finite")
    return faults


def _first(wrong: np.ndarray) -> str:
    """Return the row of the first True, as it is indexed."""
    return f"[{np.argwhere(np.atleast_1d(wrong))[0][0]}]"


def _random_control(model: Any, time_limit_s: float, control_s: float) -> list[str]:
    """Simulate some seconds under random control; return what MuJoCo warned of."""
    import mujoco

    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    rng = np.random.default_rng(0)
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]).T
    redraw = max(1, round(_REDRAW_S / model.opt.timestep))
    steps = max(1, round(control_s / model.opt.timestep))
    begun = time.monotonic()
    for step in range(steps):
        if step % redraw == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        spent = time.monotonic() - begun
        if spent > _PATIENCE_S and spent / (step + 1) * steps > time_limit_s:
            ahead = spent / (step + 1) * steps
            return [f"{control_s:g} s of random control would take {ahead:.0f} s; at most {time_limit_s} s"]
    faults = [
        f"{control_s:g} s of random control raised the warning {name.removeprefix('mjWARN_')}"
        for name, kind in mujoco.mjtWarning.__members__.items()
        if name.startswith("mjWARN_") and data.warning[kind].number
    ]
    if not np.isfinite(data.qpos).all():
        faults.append(f"{control_s:g} s of random control ended in a state that is not finite")
    return faults


def examine_model(path: Path, time_limit_s: int, control_s: float = CONTROL_S) -> dict[str, Any]:
    """Compile a model and simulate it, in this process; return the items of a `ModelReport`.

    Args:
        path: the MJCF or URDF file.
        time_limit_s: a model that would take longer to simulate is a fault, s.
        control_s: simulated time under random control, s.
    """
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, MemoryError) as error:
        fault = f"does not compile: {' '.join(str(error).split())}"
        return {"faults": [fault + _package_remedy(fault)], "sizes": {}, "notes": []}
    notes = _welded_links(path)
    sizes = {"bodies": model.nbody - 1, "joints": model.njnt, "actuators": model.nu}
    measures = {"mass_kg": float(model.body_mass.sum()), "timestep_s": model.opt.timestep}
    faults = _bad_numbers(model)
    if not (model.nv or model.nmocap):
        needed = f"nothing in it moves ({sizes['bodies']} bodies, no joints); it needs a body with a joint"
        faults.append("; ".join([needed, *notes]))
    faults = faults or _random_control(model, time_limit_s, control_s)
    return {"faults": faults, "sizes": sizes | measures, "notes": notes}


def _package_remedy(fault: str) -> str:
    """Return what helps where MuJoCo looked for a file of a ROS package."""
    compiler = '<mujoco><compiler strippath="true" meshdir="../meshes"/></mujoco>'
    remedy = (
        f"; MuJoCo resolves no package:// or other URI; add {compiler} to <robot> with the meshes' folder"
    )
    return remedy if re.search("'(package|model|file):", fault) else ""


def _welded_links(path: Path) -> list[str]:
    """Return a note for each root link of a URDF: MuJoCo welds it to the world."""
    robot = ElementTree.parse(path).getroot()
    free = {"floating", "planar"} & {joint.get("type") for joint in robot.iterfind("joint")}
    if robot.tag != "robot" or free:
        return []
    roots = {link.get("name", "") for link in robot.iterfind("link")}
    roots -= {child.get("link", "") for child in robot.iterfind("joint/child")}
    return [
        f"its root link '{name}' is welded to the world, as MuJoCo does with every URDF, and its mass has no "
        "effect; for a free base, join it to a root link without mass by a joint of type floating"
        for name in sorted(roots)
    ]


def _child(path: str, time_limit_s: str) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (int(time_limit_s), int(time_limit_s)))
    json.dump(examine_model(Path(path), int(time_limit_s)), sys.stdout)


if __name__ == "__main__":
    _child(*sys.argv[1:])
