"""Measure the structure of a checkout: size, folders, imports, dynamic attributes, and the way of one sample.

``python -m benchmarks.house [--rev GITREV] [PATH ...]`` prints one column a checkout; with two columns it also prints
the change. The script reads the layout from the files, so that it works before and after modules are moved.

Static measures (product code: `PACKAGES`)
------------------------------------------
code lines : lines with code, without blank lines, comments and docstrings. all lines : the lines of the files.
large folders : folders with more than 15 modules; `__init__` is not counted.
one importer : modules that exactly one other module imports. An import from a package's `__init__` counts for the
    module that defines the name; the imports of an `__init__` itself do not count.
import circles : groups of modules that import each other. Imports in functions and under `TYPE_CHECKING` count.
    Implicit imports of a parent package and imports by `importlib` do not.
getattr/hasattr : `hasattr(x, name)` and `getattr(x, name, default)`, by constant and by computed name.
set from outside : `x.name = value` where ``x`` is not `self` or `cls` and no class of the same file has that attribute,
    and `setattr(x, ...)`. set within file : the same where a class of the file has it, as a function has that steps
    the state declared beside it. Both are approximate: the type of ``x`` is not known. An object that the function
    itself made by `cls(...)` or its own class, a variable named `parser` and numpy's `flags` are left out.
frozen changed : `object.__setattr__` outside of the constructor and its like, and writes into `x.__dict__`.

Traced measures (in a process of their own, with numba's compiler switched off so that compiled functions are seen)
-------------------------------------------------------------------------------------------------------------------
sample files : product files of which a function or method is called on the way of one ordinary sample: from the
    subscriber's callback, which decodes the payload, over the queue, the axis and the learner, until the new snapshot
    is announced. The axis has the default configuration, with a window of 30 and a snapshot after each sample. 40
    samples are traced one by one after a warm-up. ``one sample``: the median; most samples do not enter the window.
    ``all steps``: the files that at least 2 of the 40 enter, the steps of filter and window included; diagnostics,
    due every 50th sample, are not. ``alone``: without the competing models. Lambdas, comprehensions and generated
    code (the ``__init__`` of a dataclass) are not counted.
window walk : the files on the way of the arrays through one `Window.replace` (one sample out, one in) of a full window.
    The walk enters each function that gets an array, or a tuple of arrays, at its first call, and comes back to the
    caller at its end. A stay is a part of the walk in one file. A return is a stay in a file that was visited before:
    returns = stays - files. ``calls only``: without coming back.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import io
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import threading
import tokenize
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from types import CodeType, FrameType, SimpleNamespace
from typing import Any, Final

import numpy as np
from scipy.sparse.csgraph import connected_components

PACKAGES: Final = ("adaptive", "baselines", "sim", "service", "lab")
FOLDER_LIMIT: Final = 15
ROOT: Final = Path(__file__).resolve().parents[1]
#: What the traced measures use of the product: (package to look in first, name, names in other revisions ...). The
#: module is searched for. After a renaming, add the new name and keep the old one: both layouts stay measurable.
NAMES: Final = {
    "identify_lssvm": ("adaptive", "identify_lssvm"),
    "IdentifyConfig": ("adaptive", "IdentifyConfig"),
    "Window": ("adaptive", "Window"),
    "WindowConfig": ("adaptive", "WindowConfig"),
    "fit_linear": ("baselines", "fit_linear"),
    "fit_mpi": ("baselines", "fit_mpi"),
    "fit_bouc_wen": ("baselines", "fit_bouc_wen"),
    "AxisConfig": ("service", "AxisConfig"),
    "Limits": ("service", "Limits"),
    "Bundle": ("service", "Bundle"),
    "BundleMeta": ("service", "BundleMeta"),
    "Keys": ("service", "Keys"),
    "load_axis": ("service", "load_axis"),
    "encode_samples": ("service", "encode_samples"),
    "AxisServer": ("service", "AxisServer"),
}
_SKIPPED: Final = (
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
)  # fmt: skip
_MAKERS: Final = ("__init__", "__post_init__", "__new__", "__setstate__", "__setattr__")


@dataclass(frozen=True)
class Module:
    """One source file: dotted name, path within the checkout, text, syntax tree."""

    name: str
    path: Path
    text: str
    tree: ast.Module

    @property
    def is_package(self) -> bool:
        """True for an `__init__`."""
        return self.path.name == "__init__.py"

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All nodes of the tree: walking it costs more than most measures do."""
        return list(ast.walk(self.tree))


def modules_of(root: Path, packages: Sequence[str] = PACKAGES) -> dict[str, Module]:
    """All modules of the packages under ``root``, by dotted name."""
    found = {}
    for package in packages:
        for file in sorted((root / package).rglob("*.py")):
            path = file.relative_to(root)
            parts = path.with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = file.read_text(encoding="utf-8")
            found[name] = Module(name, path, text, ast.parse(text, str(path)))
    return found


def code_lines(module: Module) -> int:
    """Lines of code, without blank lines, comments and docstrings."""
    spans = []
    for node in module.nodes:
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if ast.get_docstring(node, clean=False) is not None else None
            if first is not None:
                spans.append((first.lineno, first.end_lineno or first.lineno))
    text, lines = module.text.split("\n"), set[int]()
    for token in tokenize.generate_tokens(io.StringIO(module.text).readline):
        (begin, _), (end, _) = token.start, token.end
        docstring = token.type == tokenize.STRING and any(a <= begin and end <= b for a, b in spans)
        if token.type not in _SKIPPED and not docstring:
            lines.update(number for number in range(begin, end + 1) if text[number - 1].strip())
    return len(lines)


def imports_of(module: Module, known: dict[str, Module]) -> Iterator[tuple[str, str]]:
    """(imported module, imported name or "") for each import of a product module, wherever it is written."""
    for node in module.nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name in known:
                    yield alias.name, ""
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parts = module.name.split(".")
                up = node.level - 1 if module.is_package else node.level
                base = ".".join([*parts[: len(parts) - up], *([node.module] if node.module else [])])
            for alias in node.names:
                if f"{base}.{alias.name}" in known:
                    yield f"{base}.{alias.name}", ""
                elif base in known:
                    yield base, alias.name


def single_importers(known: dict[str, Module]) -> list[str]:
    """Modules that exactly one other module imports, as "module <- importer"."""
    offered: dict[tuple[str, str], str] = {}
    for module in known.values():
        if module.is_package:
            offered |= {(module.name, name): target for target, name in imports_of(module, known) if name}
    importers: dict[str, set[str]] = {name: set() for name, module in known.items() if not module.is_package}
    for module in known.values():
        for target, name in () if module.is_package else imports_of(module, known):
            seen = set[str]()
            while (target, name) in offered and target not in seen:
                seen.add(target)
                target = offered[target, name]
            if target in importers and target != module.name:
                importers[target].add(module.name)
    return [f"{name} <- {next(iter(by))}" for name, by in sorted(importers.items()) if len(by) == 1]


def circles(known: dict[str, Module]) -> list[list[str]]:
    """Groups of modules that import each other: the strongly connected components of the imports."""
    names = list(known)
    imports = np.zeros((len(names), len(names)), dtype=bool)
    for row, module in enumerate(known.values()):
        imports[row, [names.index(target) for target, _ in imports_of(module, known)]] = True
    count, group = connected_components(imports, connection="strong")
    groups = [sorted(name for name, own in zip(names, group, strict=True) if own == k) for k in range(count)]
    return sorted(group for group in groups if len(group) > 1)


@dataclass
class Dynamic(ast.NodeVisitor):
    """Collects what type checkers cannot see in a module: attributes by string and attributes set from outside."""

    path: Path
    declared: set[str]
    by_name: list[str] = field(default_factory=list)
    by_value: list[str] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    within: list[str] = field(default_factory=list)
    frozen: list[str] = field(default_factory=list)
    _classes: list[str] = field(default_factory=list)
    _functions: list[tuple[str, set[str]]] = field(default_factory=list)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._classes.append(node.name)
        self.generic_visit(node)
        self._classes.pop()

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        own = {"cls", "cls.__new__", "object.__new__", "self.__class__", *self._classes}
        made = {"self", "cls"} if self._classes else set()
        for part in ast.walk(node):
            if (
                isinstance(part, ast.Assign)
                and isinstance(part.value, ast.Call)
                and ast.unparse(part.value.func) in own
            ):
                made |= {target.id for target in part.targets if isinstance(target, ast.Name)}
        self._functions.append((node.name, made))
        self.generic_visit(node)
        self._functions.pop()

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_Call(self, node: ast.Call) -> None:
        called = _dotted(node.func)
        if (called == "getattr" and len(node.args) == 3) or (called == "hasattr" and len(node.args) == 2):
            constant = isinstance(node.args[1], ast.Constant)
            self._add(self.by_name if constant else self.by_value, node)
        elif called == "setattr" and node.args and not self._own(node.args[0]):
            self._add(self.outside, node)
        elif (
            called == "object.__setattr__" and not (self._functions and self._functions[-1][0] in _MAKERS)
        ) or called.endswith(".__dict__.update"):
            self._add(self.frozen, node)
        self.generic_visit(node)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        if isinstance(node.ctx, ast.Store) and not self._own(node.value):
            self._add(self.within if node.attr in self.declared else self.outside, node)
        self.generic_visit(node)

    def visit_Subscript(self, node: ast.Subscript) -> None:
        if isinstance(node.ctx, ast.Store) and isinstance(node.value, ast.Attribute) and node.value.attr == "__dict__":
            self._add(self.frozen, node)
        self.generic_visit(node)

    def _own(self, node: ast.expr) -> bool:
        if isinstance(node, ast.Name):
            return node.id == "parser" or any(node.id in made for _, made in self._functions)
        return isinstance(node, ast.Attribute) and node.attr == "flags"

    def _add(self, found: list[str], node: ast.expr) -> None:
        found.append(f"{self.path.as_posix()}:{node.lineno}: {ast.unparse(node)}")


def _dotted(node: ast.expr) -> str:
    """``a.b.c`` of names and attributes; any other beginning is left out."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join(reversed([*parts, node.id if isinstance(node, ast.Name) else ""]))


def declared_in(nodes: Sequence[ast.AST]) -> set[str]:
    """Attributes of the classes of a file: names in class bodies, and what methods set on `self`."""
    found = set[str]()
    for node in nodes:
        if isinstance(node, ast.ClassDef):
            found |= {p.target.id for p in node.body if isinstance(p, ast.AnnAssign) and isinstance(p.target, ast.Name)}
            found |= {
                t.id for p in node.body if isinstance(p, ast.Assign) for t in p.targets if isinstance(t, ast.Name)
            }
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and _dotted(node.value) == "self":
            found.add(node.attr)
    return found


def static_measures(root: Path, packages: Sequence[str] = PACKAGES) -> dict[str, Any]:
    """All measures that only read the files."""
    known = modules_of(root, packages)
    names = [p for p in packages if any(m.path.parts[0] == p for m in known.values())]
    lines = {module.name: code_lines(module) for module in known.values()}
    size: dict[str, dict[str, int]] = {"code lines": {}, "all lines": {}, "files": {}}
    for name in (*names, "total"):
        own = [m for m in known.values() if name in ("total", m.path.parts[0])]
        size["code lines"][name] = sum(lines[m.name] for m in own)
        size["all lines"][name] = sum(len(m.text.splitlines()) for m in own)
        size["files"][name] = len(own)
    folders: dict[str, int] = {}
    dynamic = [Dynamic(m.path, declared_in(m.nodes)) for m in known.values()]
    for module, visitor in zip(known.values(), dynamic, strict=True):
        visitor.visit(module.tree)
        folder = module.path.parent.as_posix()
        folders[folder] = folders.get(folder, 0) + (not module.is_package)
    return {
        **size,
        "large folders": {name: n for name, n in sorted(folders.items()) if n > FOLDER_LIMIT},
        "one importer": single_importers(known),
        "import circles": circles(known),
        "getattr/hasattr by name": [line for v in dynamic for line in v.by_name],
        "getattr/hasattr by value": [line for v in dynamic for line in v.by_value],
        "set from outside": [line for v in dynamic for line in v.outside],
        "set within file": [line for v in dynamic for line in v.within],
        "frozen changed": [line for v in dynamic for line in v.frozen],
    }


# --- traced measures: this part runs in a process of its own, which imports the product of the checkout ------------


def places(known: dict[str, Module]) -> dict[str, tuple[str, str]]:
    """(module, name) of each of `NAMES` that is defined; the shortest path where there are several."""
    defined: dict[str, list[Module]] = {}
    for module in sorted(known.values(), key=lambda m: (len(m.path.parts), m.name)):
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                defined.setdefault(node.name, []).append(module)
    found: dict[str, tuple[str, str]] = {}
    for use, (package, *names) in NAMES.items():
        for name in names:
            for module in sorted(defined.get(name, ()), key=lambda m: m.path.parts[0] != package):
                found.setdefault(use, (module.name, name))
    return found


class Trace:
    """Calls of product functions while ``on``: the files, and the walk that follows the arrays."""

    def __init__(self, root: Path) -> None:
        self.on = False
        self._root = f"{root}{os.sep}"
        self.clear()

    def clear(self) -> None:
        """Drop the trace."""
        self.files: set[str] = set()
        self.stays: list[str] = []
        self.entered: list[str] = []
        self._seen: set[CodeType] = set()
        self._open: dict[FrameType, str] = {}

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        """The profile function of `sys.setprofile`."""
        if not self.on or event not in ("call", "return"):
            return
        if event == "return":
            _append(self.stays, self._open.pop(frame, None))
            return
        code, file = frame.f_code, self._file(frame)
        if file is None or code.co_name.startswith("<"):
            return
        self.files.add(file)
        if code not in self._seen and any(_arrays(frame.f_locals.get(n)) for n in code.co_varnames[: code.co_argcount]):
            self._seen.add(code)
            _append(self.stays, file)
            _append(self.entered, file)
            caller = self._file(frame.f_back)
            if caller is not None:
                self._open[frame] = caller

    def walk(self) -> dict[str, Any]:
        """The result of the window walk."""
        result: dict[str, Any] = {}
        for name, route in (("coming back", self.stays), ("calls only", self.entered)):
            files = len(set(route))
            result[name] = {"stays": len(route), "files": files, "returns": len(route) - files}
        return {**result, "route": self.stays}

    def _file(self, frame: FrameType | None) -> str | None:
        name = frame.f_code.co_filename if frame else ""
        file = name[len(self._root) :] if name.startswith(self._root) else ""
        return file if file.split(os.sep)[0] in PACKAGES else None


def _append(route: list[str], file: str | None) -> None:
    if file is not None and route[-1:] != [file]:
        route.append(file)


def _arrays(value: object) -> bool:
    parts = value if isinstance(value, tuple) else (value,)
    return any(type(part).__name__ == "ndarray" for part in parts)


def trace_window(product: SimpleNamespace, trace: Trace) -> dict[str, Any]:
    """One sample out, one in, in a full window that has made such steps before."""
    rng, size = np.random.default_rng(0), 20
    X, y = rng.random((size, 3)), rng.random(size)
    window = product.Window.from_samples(product.WindowConfig(size, (0.6, 0.9, 1.5), 200.0), X, y)
    for step in range(2 * size + 1):
        trace.on = step == 2 * size
        window.replace(step % size, rng.random(3), float(rng.random()))
    trace.on = False
    return trace.walk()


def trace_sample(product: SimpleNamespace, trace: Trace, alone: bool) -> dict[str, Any]:
    """The files on the way of a sample from the subscriber's callback to the snapshot."""
    from unittest.mock import MagicMock

    dt_s, warm, traced, n = 0.001, 300, 40, 1200
    t = np.arange(n + warm + traced) * dt_s
    u_V = 4.0 + 2.0 * np.sin(2 * np.pi * 3.0 * t) + 1.5 * np.sin(2 * np.pi * 7.3 * t + 1.0)
    y_um, play = np.empty(t.size), 0.0
    for k, u in enumerate(u_V.tolist()):  # a stage: a gain and a play of 0.5 V
        play = min(max(play, u - 0.5), u + 0.5)
        y_um[k] = 8.0 * u + 2.0 * play
    y_um += 0.01 * np.random.default_rng(0).standard_normal(t.size)
    record, name = (u_V[:n], y_um[:n], dt_s), "lssvm_adaptive"
    config = product.IdentifyConfig(tune=False, n=30)
    models = {name: product.identify_lssvm(*record, config=config, name=name)[0]}
    if not alone:
        fits = {"linear": product.fit_linear, "mpi": product.fit_mpi, "bouc_wen": product.fit_bouc_wen}
        models |= {other: fit(*record)[0] for other, fit in fits.items()}
    meta = product.BundleMeta("demo", "x", dt_s, y_min_um=float(y_um.min()), y_max_um=float(y_um.max()))
    settings = {"learner": {"window": 30}, "snapshot_every": 1} | ({"compete": ()} if alone else {})
    config = product.AxisConfig("x", Path("x.npz"), product.Limits(0.0, 10.0, 2000.0), **settings)
    axis = product.load_axis("demo", config, bundle=product.Bundle(models, meta))
    announced, session = threading.Event(), MagicMock()

    def wake() -> None:
        trace.on = False
        announced.set()

    server = product.AxisServer(session, product.Keys("demo", "x"), axis, "one", wake)
    server.declare()
    receive = session.declare_subscriber.call_args_list[0].args[1]
    seen: list[set[str]] = []
    for first, last in [(0, warm), *((k, k + 1) for k in range(warm, warm + traced))]:
        seq = np.arange(first, last)
        payload = product.encode_samples(seq, seq * dt_s, u_V[n + seq], y_um[n + seq])
        sample = SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda payload=payload: payload))
        announced.clear()
        trace.clear()
        trace.on = first >= warm
        receive(sample)
        if not announced.wait(120.0):
            raise RuntimeError(f"no snapshot of sample {last - 1} within 120 s")
        seen += [trace.files] if first >= warm else []
    taken, events = axis.gates.get("learnt", 0) + axis.gates.get("passed", 0), axis.take_events()
    server.undeclare()
    if taken < 0.7 * (warm + traced):
        raise RuntimeError(f"the samples were not ordinary: {axis.gates}, {events}")
    often = sorted(file for file in set.union(*seen) if sum(file in files for files in seen) >= 2)
    one = sorted(seen, key=len)[traced // 2]
    return {"one sample": len(one), "all steps": len(often), "files of one sample": sorted(one), "files": often}


def drive(root: Path, measure: str) -> dict[str, Any]:
    """One traced measure of the checkout whose packages are importable."""
    import ctypes

    import numba.extending

    def pointer(address: int) -> ctypes.c_void_p:
        return ctypes.c_void_p(int(address))

    # The one intrinsic of this path turns an address into a pointer. Without the compiler this does the same.
    setattr(numba.extending, "intrinsic", lambda *given, **options: pointer if given else (lambda function: pointer))  # noqa: B010
    found = places(modules_of(root))
    if len(found) < len(NAMES):
        raise LookupError(f"not defined: {', '.join(NAMES.keys() - found.keys())}; see NAMES")
    product = SimpleNamespace(**{use: getattr(importlib.import_module(m), name) for use, (m, name) in found.items()})
    trace = Trace(root)
    sys.setprofile(trace)
    threading.setprofile(trace)
    try:
        return trace_window(product, trace) if measure == "window" else trace_sample(product, trace, measure == "alone")
    finally:
        sys.setprofile(None)


def traced_measures(root: Path) -> dict[str, Any]:
    """All measures that need the product to run; what cannot be measured is an error text."""
    environment = {**os.environ, "PYTHONPATH": str(root), "NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    done: dict[str, Any] = {}
    for key, measure in {"sample files": "default", "sample files, alone": "alone", "window walk": "window"}.items():
        call = [sys.executable, "-P", str(Path(__file__).resolve()), "--drive", measure, str(root)]
        with tempfile.TemporaryDirectory() as folder:
            ran = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        lines = (ran.stdout if ran.returncode == 0 else ran.stderr).strip().splitlines() or ["no output"]
        done[key] = json.loads(lines[-1]) if ran.returncode == 0 else {"error": lines[-1]}
    return done


# --- command ---------------------------------------------------------------------------------------------------------


def rows_of(measures: dict[str, Any]) -> dict[str, int | str]:
    """The measures of one checkout as rows of the table."""
    rows: dict[str, int | str] = {}
    for name, value in measures.items():
        if isinstance(value, list):
            rows[name] = len(value)
        elif "error" in value:
            rows[name] = "failed"
        elif name == "large folders":
            rows[name] = len(value)
        else:
            for key, part in value.items():
                if isinstance(part, dict):
                    rows |= {f"{name}, {key}: {what}": count for what, count in part.items()}
                elif not isinstance(part, list):
                    rows[f"{name}, {key}"] = part
    return rows


def table(columns: dict[str, dict[str, Any]]) -> str:
    """Plain text: a row a measure, a column a checkout, and the change where there are two."""
    cells = [rows_of(measures) for measures in columns.values()]
    names = list(dict.fromkeys(name for column in cells for name in column))
    head = ["measure", *columns, *(["change"] if len(cells) == 2 else [])]
    lines = [head]
    for name in names:
        values = [column.get(name, 0) for column in cells]
        changes = [f"{b - a:+,}" if isinstance(a, int) and isinstance(b, int) else "" for a, b in pairwise(values)]
        shown = [f"{v:,}" if isinstance(v, int) else v for v in values]
        lines.append([name, *shown, *(changes if len(values) == 2 else [])])
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True))]).rstrip()
        for line in lines
    )


def details(label: str, measures: dict[str, Any], verbose: bool) -> str:
    """What the numbers of a checkout are made of: folders, circles and errors; with ``verbose`` all lists."""
    lines = [f"{label}:"]
    for name, value in measures.items():
        if "error" in value:
            lines.append(f"  {name} failed: {value['error']}")
        elif name == "large folders":
            lines += [f"  large folder: {folder} ({count} modules)" for folder, count in value.items()]
        elif name == "import circles":
            lines += [f"  import circle: {', '.join(group)}" for group in value]
        elif verbose:
            lists = {name: value} if isinstance(value, list) else {f"{name}, {k}": v for k, v in value.items()}
            for what, entries in lists.items():
                lines += [f"  {what}: {entry}" for entry in entries] if isinstance(entries, list) else []
    return "\n".join(lines)


def exported(revision: str, folder: Path) -> Path:
    """The files of a git revision, written into a new folder under ``folder``."""
    archive = subprocess.run(["git", "archive", "--format=tar", revision], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode != 0:
        raise SystemExit(f"--rev {revision}: {archive.stderr.decode().strip()}")
    target = Path(tempfile.mkdtemp(dir=folder))
    with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as file:
        file.extractall(target, filter="data")
    return target


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the checkouts, print the table, write the JSON file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.house", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("paths", nargs="*", metavar="PATH", help="A checkout to measure; default: this one.")
    parser.add_argument(
        "--rev", action="append", default=[], metavar="GITREV",
        help="Measure a git revision of this repository, in a column before the paths; can be given several times.",
    )  # fmt: skip
    parser.add_argument("--json", type=Path, metavar="FILE", help="Write all numbers and lists to this file.")
    parser.add_argument("--static", action="store_true", help="Leave out the traced measures, which take a minute.")
    parser.add_argument("--verbose", action="store_true", help="Print what each number counts, with file and line.")
    given = parser.parse_args(arguments)
    columns: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        roots = {revision: exported(revision, Path(folder)) for revision in given.rev}
        roots |= {path: Path(path).resolve() for path in given.paths}
        for label, root in (roots or {"here": ROOT}).items():
            if not any((root / package).is_dir() for package in PACKAGES):
                parser.error(f"{label}: got no package, expected a checkout with one of {', '.join(PACKAGES)}")
            columns[label] = static_measures(root) | ({} if given.static else traced_measures(root))
    print(table(columns))
    for label, measures in columns.items():
        print(f"\n{details(label, measures, given.verbose)}")
    if given.json:
        given.json.write_text(json.dumps(columns, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--drive"]:  # as `traced_measures` starts it
        print(json.dumps(drive(Path(sys.argv[3]).resolve(), sys.argv[2])))
    else:
        raise SystemExit(main())
