"""Check of untrusted MJCF and URDF files: a scan of the XML, then a limited child process.

A hundred bytes of ``<replicate>`` occupy MuJoCo's compiler for minutes, and its parser
opens every path in a file. The XML is therefore scanned first, element by element. It
must not have document types (entities); depth, size and number of replicated elements
are bounded; and paths must stay in the model's folder or its parent (many packages have
``urdf/`` next to ``meshes/``).

A model that passes the scan is compiled in a child process with limits on time and
memory, and simulated for one second of random control, because MuJoCo also accepts time
steps of NaN and negative friction. A model that passes the whole check opens in every
MuJoCo program.
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
from typing import Any, NamedTuple, NoReturn
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from srs_twin.io.files import require_file

MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")

# Limits of a model with all its files.
MAX_FILE_BYTES = 4 << 20  # all XML together
MAX_ASSET_BYTES = 32 << 20  # all assets together
MAX_DEPTH = 400  # nested elements
MAX_ELEMENTS = 10_000  # after replication
MAX_BODIES = 1_000  # after replication
MAX_NESTED_FILES = 30  # nested includes
MAX_FOLDERS = 16  # folders of assets
MAX_CELLS = 1 << 24  # pixels of all textures and points of all height fields together

_CELLS = "pixels of textures and points of height fields"
_COUNT_LIMITS = {"elements": MAX_ELEMENTS, "bodies": MAX_BODIES, _CELLS: MAX_CELLS}

# Largest values of the attributes of <size>; memory and nstack in bytes.
_SIZE_LIMITS = {
    "memory": 1 << 30,
    "nstack": 1 << 27,
    "njmax": 1 << 20,
    "nconmax": 1 << 20,
    "nkey": 10_000,
}
_OTHER_SIZE_LIMIT = 1_000

_FOLDER_ATTRIBUTES = ("assetdir", "meshdir", "texturedir")
_BYTE_UNITS = {
    "K": 1 << 10,
    "M": 1 << 20,
    "G": 1 << 30,
    "T": 1 << 40,
    "P": 1 << 50,
    "E": 1 << 60,
}
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HUGE = 1e18  # replaces infinite numbers and limits products


class _ScanError(Exception):
    """A fault after which the scan cannot continue."""


class _Asset(NamedTuple):
    """Reference to a file that is not MJCF.

    Attributes:
        reference: line, element and path, for messages.
        path: path as written in the file.
        folder: folder of the file with the reference.
    """

    reference: str
    path: str
    folder: Path


@dataclass
class _Scan:
    """Findings and paths of one model: the main file, or an attached model.

    Attributes:
        main: resolved path of the file to check.
        root: main file of the model.
        folders: folders in which MuJoCo may look for assets.
        strips: whether MuJoCo may look for assets by file name alone (``strippath``).
        assets: references to files that are not MJCF.
        included: files that have been included.
        faults: faults of all models so far.
        models: number of elements and bodies of each attached model; None while it is
            being read.
        bytes: size of all XML and of all assets, for all models.
    """

    main: Path
    root: Path
    folders: set[str] = field(default_factory=lambda: {"."})
    strips: bool = False
    assets: list[_Asset] = field(default_factory=list)
    included: set[Path] = field(default_factory=set)
    faults: list[str] = field(default_factory=list)
    models: dict[Path, Counter[str] | None] = field(default_factory=dict)
    bytes: Counter[str] = field(default_factory=Counter)

    def existing(self, reference: str, paths: Iterable[Path]) -> list[Path] | None:
        """Return the existing ones of some paths; None, with a fault, if they are outside the folder.

        Args:
            reference: line, element and path, for the message.
            paths: all paths that MuJoCo may open for the reference.
        """
        # MuJoCo reads a backslash as a slash, and removes `..` from the text without
        # following links.
        normalised = {
            Path(os.path.normpath(str(path).replace("\\", "/"))): None for path in paths
        }
        present = [path for path in normalised if os.path.lexists(path)]
        allowed = _allowed_folder(self.main)
        outside = any(
            not Path(os.path.realpath(path)).is_relative_to(allowed) for path in present
        )
        if outside or not any(path.is_relative_to(allowed) for path in normalised):
            self.faults.append(
                f"{reference}, outside the model's folder; files in {allowed} are"
                " allowed"
            )
            return None
        return present


def _allowed_folder(main: Path) -> Path:
    """Return the folder in which all files must be.

    It is the parent of the model's folder. If the model's folder is the home directory
    or just below the root of the file system, it is the model's folder itself.
    """
    folder = main.parent
    at_home = folder == Path(os.path.realpath(os.path.expanduser("~")))
    if at_home or folder.parent == Path(folder.anchor):
        return folder
    return folder.parent


def scan_mjcf(path: Path) -> list[str]:
    """Return the faults of an MJCF or URDF file and the files that it names, without compilation.

    Args:
        path: resolved path of the file; all files that it names must be in its folder
            or the parent of that.

    Returns:
        One line per fault, with the line in the file.
    """
    scan = _Scan(path, path, models={path: None})
    try:
        _Reader(scan, path, Counter(), 0).read()
        _check_assets(scan)
    except _ScanError as fault:
        scan.faults.append(str(fault))
    return scan.faults


class _Reader:
    """Reader of one file, element by element."""

    def __init__(
        self, scan: _Scan, path: Path, count: Counter[str], depth: int
    ) -> None:
        self._scan = scan
        self._path = path
        self._count = count
        self._depth = depth
        self._times = [1]
        self._models: list[Counter[str]] = []
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = lambda _: self._times.pop()
        no_doctype = (
            "a document type (<!DOCTYPE>) is not allowed; MJCF needs no entities"
        )
        self._parser.StartDoctypeDeclHandler = lambda *_: self._refuse(no_doctype)

    def read(self) -> None:
        """Read the whole file.

        Raises:
            _ScanError: it is not XML, or exceeds a limit.
        """
        try:
            self._scan.bytes["XML"] += self._path.stat().st_size
            if self._scan.bytes["XML"] > MAX_FILE_BYTES:
                raise _ScanError(f"over {MAX_FILE_BYTES >> 20} MB of XML")
            self._parser.Parse(self._path.read_bytes(), True)
        except expat.ExpatError as error:
            self._refuse(
                f"not readable as XML ({expat.ErrorString(error.code)})", error.lineno
            )
        except (OSError, LookupError, ValueError) as error:
            # LookupError, ValueError: an unknown encoding, or one that is not allowed
            # in XML.
            self._refuse(f"not readable as XML ({error})")
        # An upper bound: any attach element may attach any of the models.
        for model in self._models:
            for kind in ("elements", "bodies"):
                self._count[kind] += self._count["attached"] * model[kind]
        self._check_count()

    def _start(self, tag: str, attributes: Mapping[str, str]) -> None:
        times = self._times[-1]
        count = self._count
        if tag in ("replicate", "composite", "flexcomp"):
            copies = times * _product(attributes.get("count", "1"))
            count["elements"] += copies
            if tag == "replicate":
                times = copies
            else:
                count["bodies"] += copies
        self._times.append(times)
        count["elements"] += times
        count["bodies"] += times * (tag == "body")
        count["attached"] += times * (tag == "attach")
        count[_CELLS] += _cells(attributes, "width", "height") + _cells(
            attributes, "nrow", "ncol"
        )
        self._check_count()
        if len(self._times) > MAX_DEPTH:
            self._refuse(f"nested more than {MAX_DEPTH} deep")
        for name, value in attributes.items():
            limit = _SIZE_LIMITS.get(name, _OTHER_SIZE_LIMIT)
            if tag == "size" and _bytes(value) > limit:
                self._refuse(
                    f"<size> asks for {name} {value}; at most {limit} is allowed"
                )
            self._scan.strips |= name == "strippath" and value != "false"
            if name in _FOLDER_ATTRIBUTES:
                folder = [self._scan.root.parent / value]
                if self._scan.existing(self._reference(tag, value), folder) is not None:
                    self._scan.folders.add(value)
                if len(self._scan.folders) > MAX_FOLDERS:
                    self._refuse(f"more than {MAX_FOLDERS} folders of assets")
            elif name.startswith("file"):
                self._read_file_attribute(tag, value)

    def _check_count(self) -> None:
        for kind, limit in _COUNT_LIMITS.items():
            if self._count[kind] > limit:
                self._refuse(f"more than {limit} {kind}, counting what is replicated")

    def _reference(self, tag: str, path: str) -> str:
        return f"{self._location()}: <{tag}> names '{path}'"

    def _read_file_attribute(self, tag: str, path: str) -> None:
        reference = self._reference(tag, path)
        folder = self._path.parent
        if tag not in ("include", "model"):
            self._scan.assets.append(_Asset(reference, path, folder))
            return
        # MuJoCo looks in the folder of the model, then in that of the file.
        present = self._scan.existing(
            reference, [self._scan.root.parent / path, folder / path]
        )
        if present == [] or not all(map(os.path.isfile, present or [])):
            raise _ScanError(f"{reference}, which is not a file")
        if self._depth == MAX_NESTED_FILES:
            raise _ScanError(
                f"{reference}; files nested more than {MAX_NESTED_FILES} deep are not"
                " allowed"
            )
        for target in present or []:
            if tag == "model":
                self._models.append(self._count_model(reference, target))
            elif target not in self._scan.included:
                self._scan.included.add(target)
                _Reader(self._scan, target, self._count, self._depth + 1).read()

    def _count_model(self, reference: str, target: Path) -> Counter[str]:
        """Return the number of elements and bodies of an attached model, which is read once."""
        scan = self._scan
        models = self._scan.models
        if target not in models:
            models[target] = None
            count: Counter[str] = Counter()
            model_scan = replace(
                scan,
                root=target,
                folders={"."},
                strips=False,
                assets=[],
                included=set(),
            )
            _Reader(model_scan, target, count, self._depth + 1).read()
            _check_assets(model_scan)
            models[target] = count
        counted = models[target]
        if counted is None:
            raise _ScanError(f"{reference}, which is a part of itself")
        return counted

    def _refuse(self, fault: str, line: int | None = None) -> NoReturn:
        raise _ScanError(f"{self._location(line)}: {fault}")

    def _location(self, line: int | None = None) -> str:
        number = line or self._parser.CurrentLineNumber
        main = self._path == self._scan.main
        if main:
            return f"line {number}"
        return f"{self._path.name}:{number}"


def _check_assets(scan: _Scan) -> None:
    """Check that the assets are files, inside the allowed folder, and not too large.

    Raises:
        _ScanError: an asset is not a file, or too large.
    """
    for reference, written, folder in scan.assets:
        names = {
            written,
            Path(written.replace("\\", "/")).name if scan.strips else written,
        }
        bases = [scan.root.parent / name for name in sorted(scan.folders)] + [folder]
        for path in (
            scan.existing(reference, [base / name for base in bases for name in names])
            or []
        ):
            if not path.is_file():
                raise _ScanError(f"{reference}, which is not a file")
            scan.bytes["assets"] += path.stat().st_size
            if scan.bytes["assets"] > MAX_ASSET_BYTES:
                raise _ScanError(
                    f"{reference}, which brings the assets above"
                    f" {MAX_ASSET_BYTES >> 20} MB"
                )
            if _png_pixels(path) > MAX_CELLS:
                raise _ScanError(
                    f"{reference}, a picture of more than {MAX_CELLS} pixels"
                )


def _png_pixels(path: Path) -> int:
    with path.open("rb") as stream:
        head = stream.read(24)
    # Width and height are the first two numbers of the header chunk.
    if head.startswith(_PNG_SIGNATURE):
        return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24])
    return 0


def _numbers(text: str) -> list[float]:
    """Return the numbers in a text; MuJoCo reports other words."""
    numbers = []
    for word in text.split():
        try:
            number = float(word)
        except ValueError:
            continue
        numbers.append(number if math.isfinite(number) else _HUGE)
    return numbers


def _product(text: str) -> int:
    """Return the product of numbers such as '10 10 1', between 1 and a large bound."""
    product = 1.0
    for number in _numbers(text):
        product = min(product * max(1.0, number), _HUGE)
    return int(product)


def _cells(attributes: Mapping[str, str], rows: str, columns: str) -> int:
    # A missing attribute is 0 to MuJoCo, which then creates nothing.
    if not {rows, columns} <= attributes.keys():
        return 0
    return _product(attributes[rows]) * _product(attributes[columns])


def _bytes(text: str) -> float:
    """Return a size such as '100', '-1' or '2G' in bytes."""
    unit = _BYTE_UNITS.get(text.strip()[-1:].upper(), 1)
    return unit * max(_numbers(text.strip().rstrip("KMGTPEkmgtpe")), default=0.0)


TIME_LIMIT_S = 30  # of the child process
MEMORY_LIMIT_BYTES = 4 << 30  # of the child process
CONTROL_S = 1.0  # simulated time under random control
MIN_TIMESTEP_S = 1e-5
MAX_TIMESTEP_S = 0.1
MAX_ITERATIONS = 10_000  # of any of the engine's solvers
_REDRAW_S = 0.02  # simulated time between two random controls
_FORECAST_AFTER_S = 0.5  # run time after which the total run time is extrapolated
_ITERATION_OPTIONS = (
    "iterations",
    "ls_iterations",
    "noslip_iterations",
    "ccd_iterations",
    "sdf_iterations",
)
_NOT_NEGATIVE = (
    "geom_friction",
    "pair_friction",
    "dof_damping",
    "dof_frictionloss",
    "body_mass",
)


@dataclass(frozen=True)
class ModelReport:
    """Result of a check.

    Attributes:
        faults: one line per fault; empty for a usable model.
        sizes: bodies, joints, actuators, mass_kg and timestep_s of the compiled model.
        notes: one line per unexpected interpretation of the file by MuJoCo.
    """

    faults: tuple[str, ...]
    sizes: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def check_mjcf(path: Path, *, time_limit_s: int = TIME_LIMIT_S) -> ModelReport:
    """Scan a model, compile it in a child process, and simulate it for one second of random control.

    Args:
        path: the MJCF or URDF file.
        time_limit_s: time limit of the child process, s.

    Raises:
        InputError: there is no such file.
    """
    remedy = "; give an MJCF or URDF file, or the name of a shipped robot"
    if path.suffix in MODEL_SUFFIXES:
        suffix = path.suffix
    else:
        suffix = ".xml"
    model = require_file(path, suffix=suffix, remedy=remedy).resolve()
    faults = scan_mjcf(model)
    if faults:
        return ModelReport(tuple(faults))
    command = [
        sys.executable,
        "-m",
        "srs_twin.plants.twin.mjcf.check",
        str(model),
        str(time_limit_s),
    ]
    # The child needs no display, and threads of NumPy would count as memory.
    env = {
        **os.environ,
        "MUJOCO_GL": "disabled",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }
    with (
        tempfile.TemporaryDirectory() as folder
    ):  # MuJoCo writes its log file to the working directory
        try:
            child = subprocess.run(
                command,
                cwd=folder,
                env=env,
                capture_output=True,
                text=True,
                timeout=time_limit_s,
            )
        except subprocess.TimeoutExpired:
            return ModelReport((f"did not finish within {time_limit_s} s",))
    messages = child.stderr.strip().splitlines()
    if messages:
        ending = messages[-1]
    else:
        ending = f"exit status {child.returncode}"
    return parse_report(child.stdout, ending, time_limit_s)


def parse_report(output: str, ending: str, time_limit_s: int) -> ModelReport:
    """Return the report of a child process, or one that says how it failed.

    Args:
        output: standard output of the child.
        ending: last line of its standard error, or its exit status.
        time_limit_s: its time limit, s.
    """
    try:
        report = json.loads(output)
    except ValueError:
        limits = f"{MEMORY_LIMIT_BYTES >> 30} GB, {time_limit_s} s"
        return ModelReport((f"broke MuJoCo or a limit ({limits}): {ending}",))
    return ModelReport(tuple(report["faults"]), report["sizes"], tuple(report["notes"]))


def _bad_numbers(model: Any) -> list[str]:
    """Return a fault for each number that MuJoCo accepts although it is physically impossible."""
    faults = []
    low = MIN_TIMESTEP_S
    high = MAX_TIMESTEP_S
    if not low <= model.opt.timestep <= high:
        faults.append(
            f"timestep {model.opt.timestep:g} s is not allowed; it must be {low:g} to"
            f" {high:g} s"
        )
    for name in _ITERATION_OPTIONS:
        if getattr(model.opt, name) > MAX_ITERATIONS:
            faults.append(
                f"{name} {getattr(model.opt, name)} are not allowed; at most"
                f" {MAX_ITERATIONS}"
            )
    for name in _NOT_NEGATIVE:
        values = getattr(model, name)
        if (values < 0).any():
            faults.append(f"{name}{_first_row(values < 0)} has a negative value")
    for name in dir(model):
        value = None if name.startswith("_") else getattr(model, name)
        if (
            isinstance(value, np.ndarray)
            and value.dtype.kind == "f"
            and not np.isfinite(value).all()
        ):
            faults.append(
                f"{name}{_first_row(~np.isfinite(value))} has a value that is not"
                " finite"
            )
    return faults


def _first_row(wrong: np.ndarray) -> str:
    """Return the row of the first True as an index such as '[3]'."""
    return f"[{np.argwhere(np.atleast_1d(wrong))[0][0]}]"


def _random_control(model: Any, time_limit_s: float, control_s: float) -> list[str]:
    """Simulate under random control; return a fault for each warning of MuJoCo.

    Args:
        model: compiled model.
        time_limit_s: limit of the run time, s.
        control_s: simulated time, s.
    """
    import mujoco

    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    rng = np.random.default_rng(0)
    low, high = np.where(
        model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-1.0, 1.0]
    ).T
    redraw = max(1, round(_REDRAW_S / model.opt.timestep))
    steps = max(1, round(control_s / model.opt.timestep))
    started = time.monotonic()
    for step in range(steps):
        if step % redraw == 0:
            data.ctrl[:] = rng.uniform(low, high)
        mujoco.mj_step(model, data)
        spent = time.monotonic() - started
        if spent > _FORECAST_AFTER_S and spent / (step + 1) * steps > time_limit_s:
            forecast = spent / (step + 1) * steps
            return [
                f"{control_s:g} s of random control would take {forecast:.0f} s; at"
                f" most {time_limit_s} s"
            ]
    faults = [
        f"{control_s:g} s of random control raised the warning"
        f" {name.removeprefix('mjWARN_')}"
        for name, kind in mujoco.mjtWarning.__members__.items()
        if name.startswith("mjWARN_") and data.warning[kind].number
    ]
    if not np.isfinite(data.qpos).all():
        faults.append(
            f"{control_s:g} s of random control ended in a state that is not finite"
        )
    return faults


def examine_model(
    path: Path, time_limit_s: int, control_s: float = CONTROL_S
) -> dict[str, Any]:
    """Compile and simulate a model in this process; return the fields of a `ModelReport`.

    Args:
        path: the MJCF or URDF file.
        time_limit_s: limit of the run time of the simulation, s.
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
    measures = {
        "mass_kg": float(model.body_mass.sum()),
        "timestep_s": model.opt.timestep,
    }
    faults = _bad_numbers(model)
    if not (model.nv or model.nmocap):
        fault = (
            f"nothing in it moves ({sizes['bodies']} bodies, no joints); it needs a"
            " body with a joint"
        )
        faults.append("; ".join([fault, *notes]))
    faults = faults or _random_control(model, time_limit_s, control_s)
    return {"faults": faults, "sizes": sizes | measures, "notes": notes}


def _package_remedy(fault: str) -> str:
    """Return a remedy if MuJoCo could not open a file of a ROS package, otherwise an empty text."""
    compiler = '<mujoco><compiler strippath="true" meshdir="../meshes"/></mujoco>'
    remedy = (
        f"; MuJoCo resolves no package:// or other URI; add {compiler} to <robot> with"
        " the meshes' folder"
    )
    if re.search("'(package|model|file):", fault):
        return remedy
    return ""


def _welded_links(path: Path) -> list[str]:
    """Return a note for each root link of a URDF, which MuJoCo welds to the world."""
    robot = ElementTree.parse(path).getroot()
    free = {"floating", "planar"} & {
        joint.get("type") for joint in robot.iterfind("joint")
    }
    if robot.tag != "robot" or free:
        return []
    roots = {link.get("name", "") for link in robot.iterfind("link")}
    roots -= {child.get("link", "") for child in robot.iterfind("joint/child")}
    return [
        f"its root link '{name}' is welded to the world, as MuJoCo does with every"
        " URDF, and its mass has no effect; for a free base, join it to a root link"
        " without mass by a joint of type floating"
        for name in sorted(roots)
    ]


def _child(path: str, time_limit_s: str) -> None:
    import resource

    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (int(time_limit_s), int(time_limit_s)))
    json.dump(examine_model(Path(path), int(time_limit_s)), sys.stdout)


if __name__ == "__main__":
    _child(*sys.argv[1:])
