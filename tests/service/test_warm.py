"""Compiling: done at set-up. That nothing is compiled under faults is looked at in ``tests/e2e/test_soak.py``."""

from __future__ import annotations

import sys
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from dehyst.service.warm import GROUPS, PACKAGES, at_first_use, make_bytecode


def test_bytecode_is_made_of_every_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    modules = [tmp_path / package / name for package in PACKAGES for name in ("__init__.py", "inner/module.py")]
    for path in modules:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("VALUE = 1\n", encoding="utf-8")
    assert make_bytecode(tmp_path) == []
    assert [path for path in modules if not Path(cache_from_source(str(path))).exists()] == []
    (tmp_path / PACKAGES[1] / "broken.py").write_text("def", encoding="utf-8")
    assert make_bytecode(tmp_path) == [PACKAGES[1]]


def installation(root: Path) -> Path:
    """``root/dehyst`` with the packages, in which each group's `warm` leaves a line in the file ``warmed``."""
    where, root = root, root / "dehyst"
    for package in (".", *PACKAGES):
        (root / package).mkdir(parents=True, exist_ok=True)
        (root / package / "__init__.py").touch()
    for name in (name for group in GROUPS for name in group):
        path = where.joinpath(*name.split(".")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"def warm():\n    print({name!r}, file=open({str(root / 'warmed')!r}, 'a'))\n")
    (root / "service" / "answers" / "__init__.py").touch()
    return root


def test_the_first_command_of_an_installation_compiles_and_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = installation(tmp_path / "site-packages")
    at_first_use(root)
    said = capsys.readouterr()
    assert said.out == ""  # where a command writes its JSON
    assert said.err.startswith("compiling the loops, once")
    assert sorted((root / "warmed").read_text().split()) == sorted(name for group in GROUPS for name in group)
    at_first_use(root)
    assert capsys.readouterr().err == ""
    (root / "sim" / "new.py").write_text("VALUE = 2\n")  # another version
    at_first_use(root)
    assert "compiled in" in capsys.readouterr().err


def test_a_checkout_is_compiled_at_set_up_and_not_by_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = installation(tmp_path / "checkout")
    at_first_use(root)
    assert not (root / "warmed").exists()
    assert capsys.readouterr().err == ""
