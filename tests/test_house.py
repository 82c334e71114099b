"""The house rules: no addresses or machine paths, no forbidden imports, and the measures of structure."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import house

ROOT = Path(__file__).resolve().parents[1]
TRACKED = [
    ROOT / name
    for name in subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
]


#: Abilities that are still found by name. A library's object or any exception may lack the attribute; nothing of ours.
ATTRIBUTES_BY_NAME_AT_MOST = 1
#: Attributes of libraries that the product sets: the output while a command redirects it, a C function's result type,
#: the clock of a process that runs with a shifted one, and whether pipython asks a controller for its errors. An object
#: of ours changes itself, by its own methods.
SET_ON_LIBRARIES = {"sys.stdout", "library.mallinfo2.restype", "time.time", "time.time_ns", "self._device.errcheck"}


@pytest.fixture(scope="module")
def measures() -> dict[str, Any]:
    return house.static_measures(ROOT)


def test_no_folder_has_more_than_15_modules_but_the_library_of_effects(measures: dict[str, Any]) -> None:
    """One effect is one file, so the files of that folder are alike."""
    assert [folder.split()[0] for folder in measures["large folders"]] == ["sim/effects"]


def test_no_modules_import_each_other(measures: dict[str, Any]) -> None:
    """Imports for type checking only count as well."""
    assert not measures["import circles"]


def test_an_ability_is_a_protocol_not_a_string(measures: dict[str, Any]) -> None:
    found = measures["getattr/hasattr by name"]
    assert len(found) <= ATTRIBUTES_BY_NAME_AT_MOST, "\n".join(found)


def test_no_attribute_is_set_on_an_object_of_another_module(measures: dict[str, Any]) -> None:
    # `adaptive.state` fills any object of ours by its declaration: that is what it is for.
    lines = [line for line in measures["set from outside"] if not line.startswith("adaptive/state.py")]
    found = [line for line in lines if line.split(": ")[1] not in SET_ON_LIBRARIES]
    assert not found, "\n".join(found)


def test_nothing_frozen_is_changed(measures: dict[str, Any]) -> None:
    assert not measures["frozen changed"]


def test_this_checkout_has_sane_numbers_and_all_that_is_traced(measures: dict[str, Any]) -> None:
    known = house.modules_of(ROOT)
    files, code = measures["files"], measures["code lines"]
    assert files["total"] > 100
    assert files["total"] == sum(n for name, n in files.items() if name != "total") == len(known)
    assert 10_000 < code["total"] < measures["all lines"]["total"]
    assert set(files) <= {*house.PACKAGES, "total"}
    assert set(house.places(known)) == set(house.NAMES), "the traced measures need these names"


def test_every_name_that_a_package_offers_can_be_imported() -> None:
    """A wrong module behind a name that is loaded on first use would fail only there."""
    missing = []
    for folder in (p.parent for top in house.PACKAGES for p in (ROOT / top).rglob("__init__.py")):
        package = importlib.import_module(".".join(folder.relative_to(ROOT).parts))
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
        "from lab.cli import COMMANDS\n"
        "for name in ('serve', 'query', 'stage', 'view', 'identify', 'demo'):\n"
        "    importlib.import_module(COMMANDS[name].module)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
