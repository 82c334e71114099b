"""``python -m benchmarks.size [PATH ...]``: lines of code by package of each checkout, the tests and benchmarks beside.

A line counts if it has code: blank lines, comments and docstrings do not. With ``--files PACKAGE`` each file of it.
"""

from __future__ import annotations

import argparse
import ast
import io
import tokenize
from pathlib import Path

PACKAGES = ("adaptive", "baselines", "sim", "service", "lab")
_LAYOUT = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENCODING", "ENDMARKER"}


def code_lines(text: str) -> int:
    """Lines of Python source with code."""
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, documented)]
    told = {(node.body[0].lineno, node.body[0].col_offset) for node in nodes if ast.get_docstring(node) is not None}
    rows, lines = text.split("\n"), set[int]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type] not in _LAYOUT and token.start not in told:
            lines.update(n for n in range(token.start[0], token.end[0] + 1) if rows[n - 1].strip())
    return len(lines)


def sizes(root: Path, package: str) -> dict[str, int]:
    """Lines of code by file of a folder below ``root``."""
    files = sorted((root / package).rglob("*.py"))
    return {str(file.relative_to(root)): code_lines(file.read_text(encoding="utf-8")) for file in files}


def main() -> None:
    """Print a line a package, its number in each checkout, and the sum of the product."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.size", description=__doc__.split("\n")[0])
    parser.add_argument("paths", nargs="*", type=Path, default=[Path()])
    parser.add_argument("--files", metavar="PACKAGE")
    given = parser.parse_args()
    if given.files:
        for root in given.paths:
            print(*(f"{lines:>7} {file}" for file, lines in sizes(root, given.files).items()), sep="\n")
        return
    table = {
        name: [sum(sizes(root, name).values()) for root in given.paths] for name in (*PACKAGES, "benchmarks", "tests")
    }
    table = {"product": [sum(column) for column in zip(*(table[name] for name in PACKAGES), strict=True)]} | table
    print(*(f"{name:<12}" + "".join(f"{lines:>9,}" for lines in row) for name, row in table.items()), sep="\n")


if __name__ == "__main__":
    main()
