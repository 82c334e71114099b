"""The measures of a checkout's structure: exact numbers of a small tree. Those of this one: ``tests/test_house.py``."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.house import FOLDER_LIMIT, Trace, main, static_measures, table

FILES = {
    "adaptive/__init__.py": '"""The package."""\nfrom adaptive.core import Core\n',
    # 10 lines of code: docstrings of module, class and function, comments and blank lines do not count.
    "adaptive/core.py": '''\
"""Two lines
of docstring."""

import os  # a comment behind code

# A comment.
class Core:
    """A class."""

    name: str = """a text

    of two lines"""

    def ability(self, other: object) -> None:
        """A method."""
        getattr(other, "freeze", None)()
        other.name = os.sep
        other.gate = hasattr(other, self.name)
''',
    "adaptive/one.py": "def f():\n    from adaptive.two import g\n    return g\n",
    "adaptive/two.py": "from . import one\n\ndef g():\n    return one\n",
    "baselines/a.py": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from baselines.b import B\n",
    "baselines/b.py": "from baselines.a import B\nfrom adaptive import Core\n",
    "service/only.py": """\
from adaptive import Core
import sim.stage

class Made:
    @classmethod
    def make(cls, other):
        made = cls()
        made.size = 1
        other.size.flags.writeable = False
        other.name[0].gain += 2
        setattr(other, "gain", 3)
        object.__setattr__(other, "gain", 3)
        other.__dict__["gain"] = getattr(other, "gain")
        return made
""",
    "sim/stage.py": "x = 1\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return tmp_path


def test_sizes_leave_out_docstrings_comments_and_blank_lines(tree: Path) -> None:
    measures = static_measures(tree)
    assert measures["code lines"] == {
        "adaptive": 1 + 8 + 3 + 3, "baselines": 3 + 2, "sim": 1, "service": 13, "total": 34
    }  # fmt: skip
    assert measures["all lines"]["total"] == sum(len(text.splitlines()) for text in FILES.values())
    assert measures["files"] == {"adaptive": 4, "baselines": 2, "sim": 1, "service": 1, "total": 8}


def test_circles_count_imports_in_functions_and_those_of_types(tree: Path) -> None:
    assert static_measures(tree)["import circles"] == [["adaptive.one", "adaptive.two"], ["baselines.a", "baselines.b"]]


def test_an_import_from_a_package_counts_for_the_module_that_defines_the_name(tree: Path) -> None:
    assert static_measures(tree)["one importer"] == [
        "adaptive.one <- adaptive.two",
        "adaptive.two <- adaptive.one",
        "baselines.a <- baselines.b",
        "baselines.b <- baselines.a",
        "sim.stage <- service.only",
    ]


def test_attributes_by_string_and_from_outside(tree: Path) -> None:
    measures = static_measures(tree)
    assert measures["getattr/hasattr by name"] == ["adaptive/core.py:16: getattr(other, 'freeze', None)"]
    assert measures["getattr/hasattr by value"] == ["adaptive/core.py:18: hasattr(other, self.name)"]
    assert measures["set within file"] == ["adaptive/core.py:17: other.name"]
    assert measures["set from outside"] == [
        "adaptive/core.py:18: other.gate",
        "service/only.py:10: other.name[0].gain",
        "service/only.py:11: setattr(other, 'gain', 3)",
    ]
    assert measures["frozen changed"] == [
        "service/only.py:12: object.__setattr__(other, 'gain', 3)",
        "service/only.py:13: other.__dict__['gain']",
    ]


def test_a_folder_with_many_modules_is_listed(tree: Path) -> None:
    assert static_measures(tree)["large folders"] == {}
    for number in range(FOLDER_LIMIT + 1):
        (tree / "sim" / f"m{number}.py").write_text("")
    assert static_measures(tree)["large folders"] == {"sim": FOLDER_LIMIT + 2}


def test_the_table_shows_the_change_and_the_json_file_the_lists(
    tree: Path, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path_factory.mktemp("other")
    (other / "sim").mkdir()
    (other / "sim" / "stage.py").write_text("x = 1\ny = 2\n")
    out = other / "house.json"
    assert main([str(tree), str(other), "--static", "--verbose", "--json", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["measure", str(tree), str(other), "change"]
    assert [line.split()[-3:] for line in lines if line.startswith("code lines, total")] == [["34", "2", "-32"]]
    assert "  import circle: baselines.a, baselines.b" in lines
    assert "  set within file: adaptive/core.py:17: other.name" in lines
    columns = json.loads(out.read_text())
    assert columns[str(tree)]["import circles"] == static_measures(tree)["import circles"]


def test_a_folder_without_packages_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--static"])
    assert "got no package" in capsys.readouterr().err


def test_a_failed_measure_is_shown_as_failed() -> None:
    shown = table({"a": {"window walk": {"error": "no Window"}}, "b": {"import circles": [["x", "y"]]}})
    assert [line.split() for line in shown.splitlines()] == [
        ["measure", "a", "b", "change"], ["window", "walk", "failed", "0"], ["import", "circles", "0", "1", "+1"],
    ]  # fmt: skip


def test_a_walk_follows_arrays_and_comes_back(tmp_path: Path) -> None:
    """first calls second twice, with an array; second calls third, which gets a number only."""
    np = pytest.importorskip("numpy")
    functions: dict[str, object] = {}
    for name, body in {"third": "x", "second": "third(1.0)", "first": "second(x) or second(x)"}.items():
        exec(compile(f"def {name}(x):\n    return {body}\n", f"{tmp_path}/adaptive/{name}.py", "exec"), functions)
    trace = Trace(tmp_path)
    from sys import getprofile, setprofile

    before, first = getprofile(), functions["first"]
    assert callable(first)
    setprofile(trace)
    trace.on = True
    first(np.zeros(1).any() and 0)  # no array: files only
    first(np.zeros(1))
    trace.on = False
    setprofile(before)
    assert trace.files == {f"adaptive/{name}.py" for name in ("first", "second", "third")}
    walk = trace.walk()
    assert walk["coming back"] == {"stays": 3, "files": 2, "returns": 1}
    assert walk["calls only"] == {"stays": 2, "files": 2, "returns": 0}
