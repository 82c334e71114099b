"""Pages of the site that are not in this folder, and links that leave it (called by mkdocs, see mkdocs.yml)."""

from __future__ import annotations

import posixpath
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

from dehyst.service.server import state_page

ROOT = Path(__file__).resolve().parents[1]
#: Files outside this folder -> the page of the site that shows them.
PAGES = {"README.md": "index.md", "clients/README.md": "clients.md"}
PROGRAMS = "programs.md"
_LINK = re.compile(r"\]\(([^)#\s]+)(#[^)\s]*)?\)")


def programs() -> str:
    """The page that holds the programs of examples/, as they are."""
    text = (
        "# Programs\n\nComplete programs of the folder `examples/` of the checkout. `examples/notebooks/` holds two "
        "notebooks: *identify and diagnose*, and *learn online*.\n"
    )
    for path in sorted((ROOT / "examples").glob("*.py")):
        text += f"\n## {path.name} {{: #{path.stem} }}\n\n```python\n{path.read_text()}```\n"
    return text


def rewritten(markdown: str, page: str) -> str:
    """``markdown`` of the file ``page`` (relative to docs/), with links out of docs/ set to pages of the site."""

    def link(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        if "://" in target or not target:
            return match[0]
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), target))
        if path.startswith("docs/"):
            return match[0]
        inside = PAGES.get(path)
        if inside is None and path.startswith("examples/") and path.endswith(".py"):
            inside, anchor = PROGRAMS, f"#{Path(path).stem}"
        if inside is None:
            return match[0]  # mkdocs reports it
        return f"]({posixpath.relpath(inside, posixpath.dirname(page) or '.')}{anchor})"

    return _LINK.sub(link, markdown)


def on_startup(**_: Any) -> None:
    """Lay the packages out as they are installed: the reader of docstrings does not import them.

    Before it looks for them: of a folder that comes later it sees nothing.
    """
    command = [sys.executable, "setup.py", "-q", "build_py", "--build-lib", "build/typed"]
    subprocess.run(command, cwd=ROOT, check=True, stderr=subprocess.DEVNULL)


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made here."""
    clients = (ROOT / "clients" / "README.md").read_text()
    # Its links are relative to clients/: make them relative to docs/.
    clients = re.sub(r"\]\(\.\./docs/", "](", clients)
    files.append(File.generated(config, "clients.md", content=clients))
    files.append(File.generated(config, PROGRAMS, content=programs()))
    files.append(File.generated(config, "state.md", content=state_page.page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Set the links of a page."""
    return rewritten(markdown, page.file.src_uri)
