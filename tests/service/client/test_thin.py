"""A client with numpy and zenoh alone: what cannot be imported there, and that its voltages are the same."""

from __future__ import annotations

import json
import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dehyst import service
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.client.follower import Follower
from dehyst.service.protocol.model import decode_model
from tests.vectors import make_vectors as vectors

OTHERS = (
    "numba", "llvmlite", "scipy", "pyarrow", "matplotlib", "rerun", "psutil", "threadpoolctl", "h5py", "nptdms",
    "openpyxl", "shtab", "filterpy", "torch",
)  # fmt: skip
WITHOUT = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
"""


def run_without(names: tuple[str, ...], program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = WITHOUT.format(names=set(names)) + program
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *arguments], capture_output=True, text=True, timeout=60
    )


def result_of(done: subprocess.CompletedProcess[str]) -> Any:
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


EVALUATE = """
import json, sys
from pathlib import Path
import numpy as np
from dehyst.adaptive.compiled import COMPILES
from dehyst.service.answers.guard import Limits
from dehyst.service.client.follower import Follower
from dehyst.service.protocol.model import decode_model
assert not COMPILES
found = {}
for path in sys.argv[1:]:
    payload = Path(path).read_bytes()
    follower = Follower(None, None, decode_model(payload).name, lambda: payload, Limits(0.0, 10.0, 2000.0))
    k = np.arange(150.0)
    y, v = 45.0 + 55.0 * np.sin(0.05 * k), 2750.0 * np.cos(0.05 * k)
    one = [(follower.point(y[i], v[i], 50.0), follower.last_std_V, follower.last_flags) for i in range(50)]
    u_V, flags = follower.trajectory(y, v, 0.0 * k)
    found[path] = [np.ravel(one).tolist(), u_V.tolist(), flags.tolist(), follower.memory.tolist()]
print(json.dumps(found))
"""


def test_every_kind_of_model_has_the_same_voltages_in_numpy_alone() -> None:
    # The forged model that overflows warns in both, which is an error here; tests/vectors has it.
    found = Path(vectors.DEFAULT_OUT).glob("*.model.payload")
    paths = sorted(str(path) for path in found if not path.name.startswith("overflowing"))
    in_numpy = result_of(run_without(OTHERS, EVALUATE, *paths))
    assert len(in_numpy) == len(paths) > 10
    for path in paths:
        payload = Path(path).read_bytes()
        name = decode_model(payload).name
        follower = Follower(None, None, name, lambda payload=payload: payload, Limits(0.0, 10.0, 2000.0))  # type: ignore
        k = np.arange(150.0)
        y, v = 45.0 + 55.0 * np.sin(0.05 * k), 2750.0 * np.cos(0.05 * k)
        one = [(follower.point(y[i], v[i], 50.0), follower.last_std_V, follower.last_flags) for i in range(50)]
        u_V, flags = follower.trajectory(y, v, 0.0 * k)
        for got, expected in zip(in_numpy[path], (np.ravel(one), u_V, flags, follower.memory), strict=True):
            np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12, err_msg=path)


CONNECT = """
import json, sys
import numpy as np
from dehyst.service.client import Client
with Client.connect(sys.argv[1], timeout_s=10.0) as client:
    y = 40.0 + 5.0 * np.sin(0.05 * np.arange(300))
    asked = client.trajectory(y, model="lssvm_adaptive")
    follower = client.follow("lssvm_adaptive")
    u_V, _ = follower.trajectory(y)
    client.command(0, u_V)
    client.reference(0, y)
    client.point(40.0)
    print(json.dumps({"asked": asked.u_V.tolist(), "followed": u_V.tolist(), "seq": client.status()["seq"]}))
"""


@pytest.mark.e2e
def test_a_thin_client_connects_asks_follows_and_commands(shared_service: Any) -> None:
    got = result_of(run_without(OTHERS, CONNECT, shared_service.endpoint))
    np.testing.assert_allclose(got["followed"], got["asked"], rtol=1e-12, atol=1e-12)
    with Client.connect(shared_service.endpoint, timeout_s=10.0) as client:
        compiled, _ = client.follow("lssvm_adaptive").trajectory(40.0 + 5.0 * np.sin(0.05 * np.arange(300)))
    np.testing.assert_allclose(got["followed"], compiled, rtol=1e-12, atol=1e-12)


def test_all_of_the_service_can_be_imported_without_fcntl() -> None:
    modules = sorted(
        name
        for _, name, _ in pkgutil.walk_packages(service.__path__, "dehyst.service.")
        if not name.endswith("__main__")
    )
    assert {"dehyst.service.server.process", "dehyst.service.storage.segments"} <= set(modules)
    program = (
        "import importlib, sys\nfor name in sys.argv[1:]:\n    importlib.import_module(name)\nprint(len(sys.argv))"
    )
    assert result_of(run_without(("fcntl", "termios", "pwd"), program, *modules)) == len(modules) + 1


def test_a_file_is_locked_by_what_windows_has(tmp_path: Path) -> None:
    program = """
import types
import subprocess  # which takes msvcrt for the sign of Windows
calls = []
fake = types.ModuleType("msvcrt")
fake.LK_NBLCK = 2
def locking(descriptor, mode, size):
    calls.append((mode, size))
    if len(calls) > 1:
        raise OSError(13, "held")
fake.locking = locking
sys.modules["msvcrt"] = fake
from pathlib import Path
from dehyst.service.storage.owner import FolderOwner
FolderOwner(Path(sys.argv[1]), "lock", "demo/x").take()
try:
    FolderOwner(Path(sys.argv[1]), "lock", "demo/x").take()
except BlockingIOError as error:
    print('["refused"]' if calls == [(2, 1), (2, 1)] and "demo/x, process" in str(error) else error)
"""
    assert result_of(run_without(("fcntl",), program, str(tmp_path))) == ["refused"]


COMMAND = "from dehyst.lab.cli import main\nsys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize(
    ("arguments", "without", "package", "extras"),
    [(["stage"], "scipy", "scipy", "serve"), (["demo"], "rerun", "rerun", "lab,viewer")],
)
def test_a_command_says_what_to_install(arguments: list[str], without: str, package: str, extras: str) -> None:
    done = run_without((without,), COMMAND, *arguments)
    assert done.returncode == 2
    assert f"needs the package {package}" in done.stderr
    assert f"pip install 'dehyst[{extras}]'" in done.stderr
