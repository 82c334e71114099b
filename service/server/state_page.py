"""What changes in an axis, for people: the entries of its state with shape, unit, range and meaning.

``python -m dehyst.service.server.state_page`` prints the page; the site has it (``docs/site_hooks.py``).
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from typing import Any, Final

from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.kernel_window import KernelSolverState
from dehyst.adaptive.online.learner import Parts
from dehyst.adaptive.state import Row, rows
from dehyst.baselines.bouc_wen.online import BoucWenOnline
from dehyst.baselines.competition.competition import Competition
from dehyst.baselines.linear import LinearOnline
from dehyst.baselines.prandtl_ishlinskii.online import MpiOnline
from dehyst.service.answers.answering import MemoryTracker
from dehyst.service.answers.which_model import ModelChoice
from dehyst.service.intake.sequence import SampleClock, SequenceTracker
from dehyst.service.server.axis import AxisEntries
from dehyst.service.server.learner_supervisor import SampleWatch, SupervisorEntries

_TITLE: Final = """\
# State of an axis

All that changes in an axis, as a checkpoint stores it and as a standby receives it; made from the declarations
(`adaptive/state.py`) by `python -m dehyst.service.server.state_page`. A state that does not fit is refused; the message
names the entry, what was got and what was expected. The axis then starts from an older checkpoint or its model file.

In brackets are shape, unit and range. p: inputs of the linear part, d: of the kernel, m: doubles of the hysteresis
memory, N: samples of the window; any other name, and `*`, is a length of that entry. -1: none yet. NaN: may be not
finite. An entry is listed once, where it comes first. The entries of a stored model are those of its
[payload](protocol.md#evaluating-a-model).
"""
#: Title of each table, where its entries are, and the class that declares them.
_TABLES: Final[tuple[tuple[str, str, Any], ...]] = (
    ("The axis", "", AxisEntries),
    ("Numbers of samples", "sequence.", SequenceTracker),
    ("Times of samples", "clock.", SampleClock),
    ("Memories of the served models", "tracker.", MemoryTracker),
    ("The supervisor of the learner", "", SupervisorEntries),
    ("The watch over the samples", "watch.", SampleWatch),
    ("The choice of the model that is served", "choice.", ModelChoice),
    ("The learner", "learner.", Parts),
    ("The window of the learner", "learner.window.", KernelSolverState),
    ("A competition", "learner.", Competition),
    ("A model that learns beside the learner: linear", "learner.model.NAME.", LinearOnline),
    ("Prandtl-Ishlinskii", "learner.model.NAME.", MpiOnline),
    ("Bouc-Wen", "learner.model.NAME.", BoucWenOnline),
)
#: Stored models, whose entries are on the page of the protocol.
_MODELS: Final = (LssvmInverse, FeatureMap)


def page() -> str:
    """The page in Markdown."""
    parts, listed = [_TITLE], dict[tuple[tuple[str, ...], ...], str]()
    told = set[tuple[str, str]]()
    for title, where, cls in _TABLES:
        new = [entry for entry in _entries(list(rows(cls, where, _MODELS)), listed) if entry not in told]
        told.update(new)
        width = max(len(name) for name, _ in new)
        parts += [f"## {title}", "", "```text", *(f"{name:<{width}}  {meaning}" for name, meaning in new), "```", ""]
    return "\n".join(parts)


def _entries(found: list[Row], listed: dict[tuple[tuple[str, ...], ...], str]) -> Iterator[tuple[str, str]]:
    """Name and meaning of each entry. The entries of a record are listed once; ``listed`` holds where."""
    skipped = "-"
    for i, row in enumerate(found):
        if row.name.startswith(skipped):
            continue
        meaning = row.meaning
        if row.name.endswith("."):
            inner = [r for r in found[i + 1 :] if r.name.startswith(row.name)]
            record = tuple((r.name.removeprefix(row.name), r.shape, r.unit, r.range, r.meaning) for r in inner)
            first = listed.setdefault(record, row.name)
            if len(record) > 2 and first != row.name:
                skipped, meaning = row.name, f"{meaning}; entries as in {first}"
        value = ", ".join(filter(None, (row.shape and f"({row.shape})", row.unit, _short(row.range))))
        yield row.name, f"{meaning} [{value}]" if value else meaning


def _short(limits: str) -> str:
    """``limits`` of a declaration in signs."""
    limits = re.sub(r"from (\S+) to ([^\s,]+)", r"\1…\2", limits)
    limits = re.sub(r"from ([^\s,]+)", r"≥\1", re.sub(r"up to ([^\s,]+)", r"≤\1", limits))
    for words, sign in (("a truth value", "bool"), ("a text", "text"), ("or not finite", "NaN")):
        limits = limits.replace(words, sign)
    return limits


def main() -> None:
    """Print the page."""
    sys.stdout.write(page())


if __name__ == "__main__":
    main()
