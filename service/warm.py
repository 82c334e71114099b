"""Compile every loop once, so that no process compiles at its start: ``python -m dehyst.service.warm``.

A checkout does it at set-up. Installed from a wheel, the first command that needs the loops does it (`at_first_use`).

It also writes the bytecode of all sources, even where Python is configured to write none, which saves 0.2 s of each
start. numba keeps its machine code on disk beside the sources. Its cache checks the file of a function, not the files
of the functions that it calls. So this module compares the digest of all sources, and compiles all when one changes.
"""

from __future__ import annotations

import compileall
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

PACKAGES = ("adaptive", "baselines", "sim", "service", "lab")
#: Modules with a ``warm()``. One process compiles each group, all at the same time.
GROUPS = (("dehyst.adaptive.warm",), ("dehyst.baselines.warm", "dehyst.sim.warm", "dehyst.service.answers.guard"))


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


#: Names of the folders that pip installs into.
_INSTALLED = ("site-packages", "dist-packages")
#: Compiled loops of a whole installation, for the progress; a little more or less does not matter.
_LOOPS = 170
#: Pause between two looks at the disk, and between two lines of progress in a log, s.
_LOOK_S, _SAID_EVERY_S = 0.5, 10.0
_ROOT = Path(__file__).resolve().parents[1]


def at_first_use(root: Path = _ROOT) -> None:
    """Compile where this is an installed package whose loops have not been compiled; says so on stderr.

    Where its folder cannot be written to, numba compiles each loop for the user when it is called.
    """
    if root.parent.name in _INSTALLED and os.access(root / "service", os.W_OK):
        compile_all(root, sys.stderr)


def main() -> int:
    """Call each ``warm()``, unless no source has changed since the last time. Returns the exit status."""
    return compile_all(_ROOT, sys.stdout)


def compile_all(root: Path, out: TextIO) -> int:
    """Call each ``warm()`` below ``root``, unless no source has changed. Tells ``out``; returns the exit status."""
    stamp = root / "service" / "__pycache__" / "compiled.sha256"
    now = digest(root)
    if stamp.exists() and stamp.read_text() == now:
        return 0
    forget(root)
    start = time.perf_counter()
    print("compiling the loops, once: 2 minutes on two idle cores, longer on busy ones ...", file=out, flush=True)
    # Where `dehyst` is imported from: beside the parts in a checkout, above them in an installation.
    home = root.parent if root.parent.name in _INSTALLED else root
    children = [
        subprocess.Popen([sys.executable, "-c", "".join(f"import {m}; {m}.warm();" for m in group)], cwd=home)
        for group in GROUPS
    ]
    failed: list[object] = list(make_bytecode(root))
    _show_progress(root, children, out)
    failed += [child.args for child in children if child.wait() != 0]
    if failed:
        print(f"service.warm: compiling failed: {failed}", file=sys.stderr)
        return 1
    stamp.parent.mkdir(exist_ok=True)
    stamp.write_text(now)
    print(f"compiled in {time.perf_counter() - start:.0f} s", file=out, flush=True)
    return 0


def _show_progress(root: Path, children: Sequence[subprocess.Popen[bytes]], out: TextIO) -> None:
    """How far it is by the machine code on the disk, until all ``children`` have ended: a bar, or lines in a log."""
    start_s = said_s = time.monotonic()
    bar = "\r  [{:<30}] {}" if out.isatty() else ""
    while any(child.poll() is None for child in children):
        now_s = time.monotonic()
        done = sum(1 for package in PACKAGES for _ in (root / package).rglob("*.nbi"))
        text = f"{done} of some {_LOOPS} loops, {now_s - start_s:.0f} s"
        if bar:
            print(bar.format("#" * min(30, 30 * done // _LOOPS), text), end="", file=out, flush=True)
        elif now_s - said_s >= _SAID_EVERY_S:
            said_s = now_s
            print(f"  {text}", file=out, flush=True)
        time.sleep(_LOOK_S)
    if bar:
        print(file=out)


if __name__ == "__main__":
    sys.exit(main())
