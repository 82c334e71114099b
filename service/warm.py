"""Compile every loop once, so that no process compiles at its start: ``python -m service.warm``.

It also writes the bytecode of all sources, even where Python is configured to write none, which saves 0.2 s of each
start. numba keeps its machine code on disk beside the sources. Its cache checks the file of a function, not the files
of the functions that it calls. So this module compares the digest of all sources, and compiles all when one changes.
"""

from __future__ import annotations

import compileall
import hashlib
import subprocess
import sys
import time
from pathlib import Path

PACKAGES = ("adaptive", "baselines", "sim", "service", "lab")
#: Modules with a ``warm()``. One process compiles each group, all at the same time.
GROUPS = (("adaptive.warm",), ("baselines.warm", "sim.warm", "service.answers.guard"))


def digest(root: Path) -> str:
    """The digest of all sources and of the version of Python, as hexadecimal text."""
    sha = hashlib.sha256(sys.version.encode())
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            sha.update(path.relative_to(root).as_posix().encode())
            sha.update(path.read_bytes())
    return sha.hexdigest()


def forget(root: Path) -> None:
    """Remove the machine code that numba keeps."""
    for package in PACKAGES:
        for path in (root / package).rglob("*.nb[ic]"):
            path.unlink(missing_ok=True)


def make_bytecode(root: Path) -> list[str]:
    """Write the bytecode of all modules. Returns the packages where some failed."""
    return [name for name in PACKAGES if not compileall.compile_dir(root / name, quiet=1)]


def main() -> int:
    """Call each ``warm()``, unless no source has changed since the last time. Returns the exit status."""
    root = Path(__file__).resolve().parents[1]
    stamp = root / "service" / "__pycache__" / "compiled.sha256"
    now = digest(root)
    if stamp.exists() and stamp.read_text() == now:
        return 0
    forget(root)
    start = time.perf_counter()
    print("compiling the loops, once (a minute or two) ...", flush=True)
    children = [
        subprocess.Popen([sys.executable, "-c", "".join(f"import {m}; {m}.warm();" for m in group)], cwd=root)
        for group in GROUPS
    ]
    failed: list[object] = [*make_bytecode(root), *(child.args for child in children if child.wait() != 0)]
    if failed:
        print(f"service.warm: compiling failed: {failed}", file=sys.stderr)
        return 1
    stamp.parent.mkdir(exist_ok=True)
    stamp.write_text(now)
    print(f"compiled in {time.perf_counter() - start:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
