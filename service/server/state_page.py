"""What changes in an axis, for people: the entries of its state with shape, unit, range and meaning.

``python -m dehyst.service.server.state_page`` prints the page; the site has it (``docs/site_hooks.py``).
"""

from __future__ import annotations

import sys
from typing import Any, Final

from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.kernel_window import KernelState
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
memory, N: samples of the window; any other name, and `*`, is a length of that entry. -1: none yet. An entry is listed
once, where it comes first. The entries of a stored model are those of its
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
    ("The window of the learner", "learner.window.", KernelState),
    ("A competition", "learner.", Competition),
    ("A model that learns beside the learner: linear", "learner.model.NAME.", LinearOnline),
    ("Prandtl-Ishlinskii", "learner.model.NAME.", MpiOnline),
    ("Bouc-Wen", "learner.model.NAME.", BoucWenOnline),
)


def page() -> str:
    """The page in Markdown."""
    parts, told = [_TITLE], set[Row]()
    # The entries of stored models are on the page of the protocol.
    listed: dict[Any, str] = {LssvmInverse: "", FeatureMap: ""}
    for title, where, cls in _TABLES:
        new = [entry for entry in rows(cls, where, listed) if entry not in told]
        told.update(new)
        width = max(len(name) for name, _ in new)
        parts += [f"## {title}", "", "```text", *(f"{name:<{width}}  {meaning}" for name, meaning in new), "```", ""]
    return "\n".join(parts)


if __name__ == "__main__":
    sys.stdout.write(page())
