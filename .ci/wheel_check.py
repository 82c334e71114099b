"""Build the wheel, install it into a fresh environment, and run its command, its client and the demonstration there.

    python .ci/wheel_check.py            # from the environment that has everything; needs a package index

At first the fresh environment holds what a client needs and no more; the service that the client asks runs in the
environment that calls this. Then the extras come, and `dehyst demo --fast` runs as for a new user: it compiles the
loops. Prints sizes and times.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CLIENT = """
import sys, time
begin = time.perf_counter()
from dehyst.service.client.client import Client
imported_s = time.perf_counter() - begin
heavy = sorted({"numba", "scipy", "pyarrow", "matplotlib", "rerun", "psutil"} & set(sys.modules))
assert not heavy, heavy
with Client.connect(sys.argv[1], timeout_s=10.0, wait_s=30.0) as client:
    asked = client.trajectory([40.0, 40.5, 41.0])
    follower = client.follow()
    followed, _ = follower.trajectory([40.0, 40.5, 41.0])
assert abs(asked.u_V - followed).max() < 1e-12, (asked.u_V, followed)
print(f"import {imported_s:.2f} s, voltages {asked.u_V.tolist()}")
"""


def megabytes(folder: Path) -> float:
    """Size of all files below ``folder``, MB."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def run(*command: object, cwd: Path) -> str:
    """Standard output of a command, which must succeed."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([str(part) for part in command], cwd=cwd, env=clean, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{command[0]}: exit status {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout.strip()


def main() -> int:
    """All steps; raises SystemExit at the first that fails."""
    sys.path.insert(0, str(ROOT))
    from tests.service.conftest import ServeProcess, unused_port, write_config

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        run(sys.executable, "-m", "pip", "wheel", "-q", ROOT, "--no-deps", "-w", folder / "wheel", cwd=folder)
        (wheel,) = (folder / "wheel").glob("dehyst-*.whl")
        venv.create(folder / "env", with_pip=True)
        bin_folder = folder / "env" / ("Scripts" if os.name == "nt" else "bin")
        python = bin_folder / "python"
        before_MB, begin = megabytes(folder / "env"), time.monotonic()
        run(python, "-m", "pip", "install", "-q", "--disable-pip-version-check", wheel, cwd=folder)
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB; installed with what a client needs: "
              f"{megabytes(folder / 'env') - before_MB:.0f} MB in {time.monotonic() - begin:.0f} s")  # fmt: skip
        print(run(bin_folder / "dehyst", "--version", cwd=folder))
        refused = subprocess.run([bin_folder / "dehyst", "serve", "--example"], capture_output=True, text=True)
        assert refused.returncode == 2, refused.stderr
        assert "pip install 'dehyst[serve]'" in refused.stderr, refused.stderr
        port = unused_port()
        service = ServeProcess(write_config(folder, port), port)
        try:
            print(run(python, "-c", CLIENT, service.endpoint, cwd=folder))
        finally:
            service.kill()
        listed = json.loads(run(python, "-m", "pip", "list", "--format", "json", cwd=folder))
        print("packages: " + ", ".join(sorted(one["name"] for one in listed)))
        demonstrate(bin_folder, wheel, folder)
    return 0


def demonstrate(bin_folder: Path, wheel: Path, folder: Path) -> None:
    """Install the extras and run the demonstration; its adaptive model must settle below 0.1 % of the range."""
    begin = time.monotonic()
    run(bin_folder / "python", "-m", "pip", "install", "-q", "--disable-pip-version-check",
        f"{wheel}[serve,viewer,lab]", cwd=folder)  # fmt: skip
    installed_s, begin = time.monotonic() - begin, time.monotonic()
    summary = json.loads(
        run(bin_folder / "dehyst", "demo", "--fast", "--out", folder / "demo", "--quiet", "--json", cwd=folder)
    )
    settled = summary["models"]["lssvm_adaptive"]["settled"]["mae_pct"]
    print(f"all extras: {megabytes(folder / 'env'):.0f} MB, installed in {installed_s:.0f} s; dehyst demo --fast: "
          f"{time.monotonic() - begin:.0f} s, settled error {settled:.3f} %")  # fmt: skip
    assert settled < 0.1, settled


if __name__ == "__main__":
    sys.exit(main())
