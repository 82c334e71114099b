"""Compile every compiled loop once, so that no process pays for it at its start: ``python -m service.warm``.

The sources become bytecode as well, also where Python was told to write none: a fifth of a second of each start. What
was compiled is kept on disk beside the sources. That cache looks at the file of a function only, not at the files of
what it calls; so the sources are compared as a whole here, and one changed file makes all anew.
"""

from __future__ import annotations

import compileall
import hashlib
import subprocess
import sys
import time
from pathlib import Path

PACKAGES = ("adaptive", "baselines", "sim", "service", "lab")
#: What is compiled side by side, in a process each: modules with a ``warm()``.
GROUPS = (("adaptive.warm",), ("baselines.warm", "sim.warm", "service.answers.guard"))


def digest(root: Path) -> str:
    """Of all sources that may be compiled, and of the Python that runs them."""
    sha = hashlib.sha256(sys.version.encode())
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            sha.update(path.relative_to(root).as_posix().encode())
            sha.update(path.read_bytes())
    return sha.hexdigest()


def forget(root: Path) -> None:
    """Remove what was compiled before."""
    for package in PACKAGES:
        for path in (root / package).rglob("*.nb[ic]"):
            path.unlink(missing_ok=True)


def make_bytecode(root: Path) -> list[str]:
    """Of all modules of the packages; returns the packages of which not all could be made."""
    return [name for name in PACKAGES if not compileall.compile_dir(root / name, quiet=1)]


def main() -> int:
    """Call each ``warm()``, unless nothing has changed since the last time."""
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
