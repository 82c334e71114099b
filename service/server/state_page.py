"""What changes in an axis, for people: the entries of its state with shape, unit, range and meaning.

``python -m service.server.state_page`` prints the page, which is ``docs/state.md``.
"""

from __future__ import annotations

import sys
from typing import Any, Final

from adaptive.features import FeatureMap
from adaptive.inverse_model import LssvmInverse
from adaptive.online.kernel_window import KernelSolverState
from adaptive.online.learner import Parts
from adaptive.state import rows
from baselines.bouc_wen.model import BoucWenInverse
from baselines.bouc_wen.online import BoucWenOnline
from baselines.competition.champion import ChampionEntries
from baselines.competition.competition import Competition
from baselines.linear import LinearInverse, LinearOnline
from baselines.prandtl_ishlinskii.model import MpiInverse
from baselines.prandtl_ishlinskii.online import MpiOnline
from service.answers.answering import MemoryTracker
from service.answers.which_model import ModelChoice
from service.intake.sequence import SampleClock, SequenceTracker
from service.server.axis import AxisEntries
from service.server.learner_supervisor import SampleWatch, SupervisorEntries

_TITLE: Final = """\
# State of an axis

All that changes in an axis, as a checkpoint stores it and as a standby receives it. Each entry is declared once, where
it is used (`adaptive/state.py`); saving, loading with checks and this page follow from the declaration. A state with an
entry that is missing, unknown, of another type or shape, or out of range is refused, with the entry, what was got and
what was expected; the axis then starts from an older checkpoint or from its model file. A number or a text has no
shape. A dimension is a number or a name: p inputs of the linear part, d of the kernel, m of the hysteresis memory,
N samples of the window; any other name, and `*`, is a length of that entry. Numbers are finite unless stated.

This page is generated: `python -m service.server.state_page > docs/state.md`.
"""
#: Title of each table, where its entries are, and who declares them.
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
    ("A linear model that learns", "learner.model.NAME.", LinearOnline),
    ("A Prandtl-Ishlinskii model that learns", "learner.model.NAME.", MpiOnline),
    ("A Bouc-Wen model that learns", "learner.model.NAME.", BoucWenOnline),
    ("A stored LSSVM model", "", LssvmInverse),
    ("A feature map", "", FeatureMap),
    ("A stored linear model", "", LinearInverse),
    ("A stored Prandtl-Ishlinskii model", "", MpiInverse),
    ("A stored Bouc-Wen model", "", BoucWenInverse),
    ("A stored model of a competition", "", ChampionEntries),
)


def page() -> str:
    """The page in Markdown."""
    lines = [_TITLE]
    for title, where, cls in _TABLES:
        apart = {LssvmInverse, FeatureMap} - {cls}
        lines += [f"## {title}", "", "| entry | shape | unit | range | meaning |", "|---|---|---|---|---|"]
        for row in rows(cls, where, apart):
            cells = (f"`{row.name}`", row.shape, row.unit, row.range, row.meaning)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    """Print the page."""
    sys.stdout.write(page())


if __name__ == "__main__":
    main()
