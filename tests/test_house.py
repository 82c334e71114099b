"""The house rules: no addresses or machine paths, no forbidden imports, and the measures of structure."""

from __future__ import annotations

import importlib
import json
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from benchmarks import size

ROOT = Path(__file__).resolve().parents[1]
TRACKED = [
    ROOT / name
    for name in subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
]


def test_no_folder_has_more_than_15_modules_but_the_library_of_effects() -> None:
    """One effect is one file, so the files of that folder are alike."""
    folders = Counter(
        path.parent for top in size.PACKAGES for path in (ROOT / top).rglob("*.py") if path.stem[0] != "_"
    )
    assert [str(folder.relative_to(ROOT)) for folder, files in folders.items() if files > 15] == ["sim/effects"]


def test_no_modules_import_each_other(tmp_path: Path) -> None:
    """Imports in functions and for type checking only count as well. They are laid out as installed."""
    layout = [sys.executable, "setup.py", "-q", "build_py", "--build-lib", str(tmp_path)]
    subprocess.run(layout, cwd=ROOT, capture_output=True, check=True)
    program = (
        "import grimp, json; graph = grimp.build_graph('dehyst', cache_dir=None); "
        "print(json.dumps({name: [*graph.find_modules_directly_imported_by(name)] for name in graph.modules}))"
    )
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    imported = json.loads(done.stdout)
    assert len(imported) > 300
    modules = {name: i for i, name in enumerate(sorted(imported))}
    pairs = [(modules[name], modules[other]) for name in modules for other in imported[name]]
    rows, columns = zip(*pairs, strict=True)
    imports = csr_array((np.ones(len(pairs)), (rows, columns)), shape=(len(modules), len(modules)))
    groups = connected_components(imports, connection="strong")[1]
    circles = [[name for name, i in modules.items() if groups[i] == group] for group in np.unique(groups)]
    assert [circle for circle in circles if len(circle) > 1] == []


def test_lines_of_code_are_counted() -> None:
    lines = ['"""What it is."""', "", "x = 1  # one", "", "# none", "def f():", '    """It does."""', '    y = """']
    text = "\n".join([*lines, "", '"""', "    return (", "        y", "    )", ""])
    assert size.code_lines(text) == 7
    assert 20_000 < sum(sum(size.sizes(ROOT, name).values()) for name in size.PACKAGES) < 60_000


def test_every_name_that_a_package_offers_can_be_imported() -> None:
    """A wrong module behind a name that is loaded on first use would fail only there."""
    missing = []
    for folder in (p.parent for top in size.PACKAGES for p in (ROOT / top).rglob("__init__.py")):
        package = importlib.import_module(".".join(("dehyst", *folder.relative_to(ROOT).parts)))
        offered = getattr(package, "__all__", ())
        modules = {file.stem for file in folder.glob("*.py")} | {inner.name for inner in folder.iterdir()}
        missing += [f"{package.__name__}.{name}" for name in {*offered} - modules if not hasattr(package, name)]
    assert not missing


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-test.txt"])
def test_requirements_are_pinned_by_hash_and_name_no_registry(name: str) -> None:
    text = (ROOT / name).read_text()
    assert not re.search(r"https?://|--(extra-)?index-url|^-i ", text, re.M)
    pins = re.findall(r"^[A-Za-z0-9_.-]+==", text, re.M)
    assert len(pins) > 15
    blocks = re.split(r"\n(?=\S)", text.strip())
    unhashed = [block.split()[0] for block in blocks if "--hash=sha256:" not in block]
    assert not unhashed, f"no hash for {unhashed}"


def test_running_needs_no_torch() -> None:
    assert not re.search(r"^(torch|nvidia)", (ROOT / "requirements.txt").read_text(), re.M)


def test_no_measured_data_is_committed() -> None:
    heavy = [p for p in TRACKED if p.suffix in {".csv", ".npz", ".mat", ".parquet", ".rrd"}]
    assert not heavy


def test_no_file_names_a_machine_path() -> None:
    pattern = re.compile(r"/(?:root|work|home)/[a-z]")
    named = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in TRACKED
        if path.suffix in {".py", ".md", ".toml", ".txt", ".cfg"} and path.exists()
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if pattern.search(line) and path != Path(__file__)
    ]
    assert not named


def test_serving_imports_no_torch_and_works_where_it_is_missing() -> None:
    """The whole of what `dehyst serve` and `dehyst demo` import, with torch made unimportable."""
    program = (
        "import sys; sys.modules['torch'] = None\n"
        "import importlib\n"
        "from dehyst.lab.cli import COMMANDS\n"
        "for name in ('serve', 'query', 'stage', 'view', 'identify', 'demo'):\n"
        "    importlib.import_module(COMMANDS[name].module)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
