"""The configuration is read strictly, and says what is wrong with it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.config.reference import example, page
from dehyst.service.config.settings import parse_config, read_config
from dehyst.service.runtime.session import check_endpoint, is_loopback

GOOD = """
stage = "demo"
[[axis]]
name = "x"
model = "x.npz"
u_min_V = 0
u_max_V = 10
slew_V_per_s = 2000.0
[axis.learner]
window = 300
"""


def test_a_short_configuration_has_safe_defaults(tmp_path: Path) -> None:
    config = parse_config(GOOD, "f", tmp_path)
    (axis,) = config.axes
    assert config.listen == ("tcp/127.0.0.1:7447",)
    assert axis.model == tmp_path / "x.npz"
    assert (axis.limits.u_min_V, axis.limits.u_max_V, axis.limits.slew_V_per_s) == (0.0, 10.0, 2000.0)
    assert math.isinf(axis.limits.y_max_um)
    assert axis.learner == {"window": 300}
    assert (axis.served, axis.learn, axis.recorder) == ("auto", "lssvm_adaptive", None)


@pytest.mark.parametrize("what", ["checkpoints", "recorder"])
def test_one_folder_for_two_axes_is_refused_and_says_whose_it_is(what: str, tmp_path: Path) -> None:
    axis = GOOD.split("[[axis]]")[1].split("[axis.learner]")[0]
    other = axis.replace('"x"', '"y"', 1)
    text = f'stage = "demo"\n[[axis]]{axis}{what} = "kept"\n[[axis]]{other}{what} = "./kept"\n'
    with pytest.raises(
        InputError, match=rf"axis y: {what}: got .*kept, which is also that of axis x, expected a folder"
    ):
        parse_config(text, "f", tmp_path)
    parse_config(text.replace("./kept", "kept/y"), "f", tmp_path)


def test_the_example_has_every_key_and_every_default(tmp_path: Path) -> None:
    shown = parse_config(example(), "example", tmp_path)
    assert shown.stage == "demo"
    # Uncommented as well: each key exists, and each default is the one that holds without the key.
    lines = [line.removeprefix("# ") for line in example().splitlines() if not line.startswith("# Configuration")]
    full = parse_config("\n".join(lines), "example", tmp_path)
    given = {"recorder": tmp_path / "recordings/x", "checkpoints": tmp_path / "checkpoints/x", "stand_in": "mpi"}
    limits = replace(shown.axes[0].limits, y_min_um=-5.0, y_max_um=95.0)
    assert full.axes == (replace(shown.axes[0], limits=limits, **given),)  # type: ignore[arg-type]
    assert replace(full, axes=(), zenoh_config=None, key=None) == replace(shown, axes=())


def test_the_page_of_the_configuration_is_the_schema() -> None:
    """Keys, defaults and ranges; the meanings of nested tables come from docstrings and may be newer."""
    committed = (Path(__file__).resolve().parents[3] / "docs" / "configuration.md").read_text(encoding="utf-8")

    def cells(text: str) -> list[list[str]]:
        return [line.split(" | ")[:2] for line in text.splitlines() if line.startswith("| `")]

    assert len(cells(committed)) > 90
    assert cells(committed) == cells(page()), "run: python -m dehyst.service.config.reference > docs/configuration.md"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('stage = "demo"', 'stage = "demo"\nspeed = 3', ["speed", "3", "known keys", "listen"]),
        ("u_max_V = 10", "u_max_V = 10\numax = 3", ["axis[0].umax", "known keys", "u_max_V"]),
        ("u_max_V = 10", "", ["axis[0].u_max_V", "nothing", "no default"]),
        ("u_max_V = 10", 'u_max_V = "10"', ["u_max_V", "'10'", "a number"]),
        ("u_max_V = 10", "u_max_V = -1", ["axis[0].u_max_V", "u_min_V < u_max_V"]),
        ("u_max_V = 10", "u_max_V = nan", ["u_max_V", "nan"]),
        ("u_max_V = 10", "u_max_V = 10\nsnapshot_every = 0", ["snapshot_every", "1 to 100000"]),
        ("u_max_V = 10", "u_max_V = 10\nsnapshot_every = true", ["snapshot_every", "True"]),
        ('name = "x"', 'name = "X/1"', ["axis[0].name", "'X/1'", "a-z"]),
        ('model = "x.npz"', "", ["axis[0].model", "dehyst identify"]),
        ('stage = "demo"', "stage = 5", ["stage", "5", "a text"]),
        ('stage = "demo"', 'stage = "demo"\nlisten = ["127.0.0.1:1"]', ["listen", "127.0.0.1:1", "protocol/host:port"]),
        (
            'stage = "demo"',
            'stage = "demo"\nlisten = ["tcp/0.0.0.0:7447"]',
            ["listen", "this machine", "beyond_loopback"],
        ),
        ('stage = "demo"', 'stage = "demo"\nlisten = []', ["listen", "nothing"]),
        ('stage = "demo"', "stage = ", ["f", "TOML", "line 2"]),
        ("[[axis]]", "[axis]", ["axis", "a list of tables"]),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, words: list[str], tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        parse_config(GOOD.replace(old, new, 1), "f", tmp_path)
    for word in words:
        assert word in str(refused.value)


def test_two_axes_of_one_name_are_refused(tmp_path: Path) -> None:
    twice = GOOD + GOOD[GOOD.index("[[axis]]") :]
    with pytest.raises(InputError, match="different name"):
        parse_config(twice, "f", tmp_path)
    assert [axis.name for axis in parse_config(twice.replace('"x"', '"y"', 1), "f", tmp_path).axes] == ["y", "x"]


def test_other_machines_only_when_said_so(tmp_path: Path) -> None:
    text = 'insecure_beyond_loopback = true\nlisten = ["tcp/0.0.0.0:7447"]\n' + GOOD
    assert parse_config(text, "f", tmp_path).listen == ("tcp/0.0.0.0:7447",)


def test_a_missing_file_says_how_to_begin(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--example"):
        read_config(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [("tcp/127.0.0.1:1", True), ("tcp/localhost:7447", True), ("tcp/[::1]:7447", True),
     ("unixsock-stream//tmp/a", True),
     ("tcp/0.0.0.0:7447", False), ("tls/lab.example:7447", False), ("tcp/[::]:7447", False)],
)  # fmt: skip
def test_loopback_is_told_from_the_rest(endpoint: str, local: bool) -> None:
    assert check_endpoint("listen", endpoint) == endpoint
    assert is_loopback(endpoint) is local


@pytest.mark.parametrize("endpoint", ["", "tcp", "tcp/127.0.0.1", "tcp/127.0.0.1:0", "tcp/a:70000", "http/a:1", 5])
def test_bad_endpoints_are_refused(endpoint: object) -> None:
    with pytest.raises(InputError, match="listen"):
        check_endpoint("listen", endpoint)
