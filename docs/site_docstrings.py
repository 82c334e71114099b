"""Docstrings of this project as Markdown for the API page (an extension of griffe, see mkdocs.yml).

A section is a heading underlined by hyphens. In it an entry begins with ``name :`` or ``name, name :``, also in the
middle of a line after the end of a sentence.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises)\n-+\n", re.M)
_ENTRY = re.compile(r"(?:^|(?<=[.;:)]\s))((?:\*{0,2}\w+)(?:, \w+)*) :\s", re.M)
_ROLE = re.compile(r":\w+:(?=`)")


def as_markdown(text: str) -> str:
    """``text`` of a docstring as Markdown."""
    first, *sections = _SECTION.split(_ROLE.sub("", text))
    out = [first.rstrip()]
    for name, body in zip(sections[::2], sections[1::2], strict=True):
        blocks = re.split(r"\n\n+", body.strip())
        # The section ends at an empty line, unless another entry follows.
        count = next((i for i, block in enumerate(blocks) if i and not _ENTRY.match(block)), len(blocks))
        # An entry goes on in indented lines: one line an entry, so that the pattern finds its beginning.
        lines = "\n".join(re.sub(r"\n\s+", " ", block) for block in blocks[:count])
        found = list(_ENTRY.finditer(lines))
        ends = [match.start() for match in found[1:]] + [len(lines)]
        entries = [(match[1], lines[match.end() : end].strip()) for match, end in zip(found, ends, strict=False)]
        items = "\n".join(f"- **{names}**: {' '.join(words.split())}" for names, words in entries)
        out += [f"**{name}**\n\n{items or lines}", *blocks[count:]]
    return "\n\n".join(out)


class HouseDocstrings(griffe.Extension):
    """Rewrites each docstring as it is loaded."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
