"""Every thread of the service has a name and a row in the architecture page."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Threads that are named after the module that their process runs.
NAMED_BY_VALUE = {"service/background/job.py": "dehyst.service.background"}


def test_every_thread_is_named_and_listed() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    found = []
    for path in sorted((ROOT / "service").rglob("*.py")):
        where = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and ast.unparse(node.func) in ("threading.Thread", "Thread")):
                continue
            names = [keyword.value for keyword in node.keywords if keyword.arg == "name"]
            assert names, f"{where}:{node.lineno}: a thread without a name"
            first = names[0].values[0] if isinstance(names[0], ast.JoinedStr) else names[0]
            name = first.value if isinstance(first, ast.Constant) else NAMED_BY_VALUE[where]
            found.append(name)
            assert f"`{name}" in page, f"{where}:{node.lineno}: the page does not list the thread {name}"
    assert len(found) >= 12
