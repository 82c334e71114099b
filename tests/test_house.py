"""The house rules that a file can break: addresses, paths, imports that must not happen."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TRACKED = [
    ROOT / name
    for name in subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
]


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
