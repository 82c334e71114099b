"""Judges scenarios: in no half second may adapting be worse than not adapting. Table and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from adaptive.types import FloatArray
from lab.scenarios.run import ADAPTIVE, FROZEN, ScenarioRecord

#: In every window of this length, s, the adaptive mean absolute error may be at most ...
WINDOW_S: Final = 0.5
#: ... this many times the frozen model's ...
FACTOR: Final = 1.1
#: ... plus this many noise floors.
FLOORS: Final = 3.0
#: Length of "settled" at the end of the run, and of "before" just before the change, s.
SETTLED_S: Final = 10.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a scenario; errors are mean absolute errors in percent of the commanded range.

    Attributes
    ----------
    before_pct, first_second_pct, settled_pct : of the adaptive model, before the change (up to 10 s), in the first
    second, and at the end (10 s); ``frozen_*`` of the model that does not adapt.
    worst_ratio : largest error of a window over what that window allows; held if at most 1.
    worst_s : middle of that window, s. worst_pct, worst_frozen_pct : the two errors in it.
    broken_share : share of all windows above what they allow.
    floor_pct : noise floor at the end.
    """

    name: str
    kind: str
    seed: int
    text: str
    before_pct: float
    first_second_pct: float
    settled_pct: float
    frozen_before_pct: float
    frozen_first_second_pct: float
    frozen_settled_pct: float
    worst_ratio: float
    worst_s: float
    worst_pct: float
    worst_frozen_pct: float
    broken_share: float
    floor_pct: float
    held: bool
    verdicts: dict[str, int]
    counters: dict[str, int]

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {key: round(value, 6) if isinstance(value, float) else value for key, value in asdict(self).items()}


@dataclass(frozen=True, slots=True)
class Windows:
    """Mean absolute errors of every window, µm; ``t_s`` is the middle of a window."""

    t_s: FloatArray
    adaptive_um: FloatArray
    frozen_um: FloatArray
    allowed_um: FloatArray

    @property
    def ratio(self) -> FloatArray:
        """Adaptive error over what is allowed."""
        return self.adaptive_um / self.allowed_um


def windows(course: ScenarioRecord) -> Windows:
    """All windows: one begins at each sample."""
    dt = course.scenario.stage.dt_s
    span = max(1, round(WINDOW_S / dt))

    def moving(values: FloatArray) -> FloatArray:
        total = np.concatenate([[0.0], np.cumsum(values)])
        means: FloatArray = (total[span:] - total[:-span]) / span
        return means

    adaptive, frozen = (moving(np.abs(course.error_um[name])) for name in (ADAPTIVE, FROZEN))
    t_s: FloatArray = ((np.arange(adaptive.size) + 0.5 * span) * dt).astype(np.float64)
    return Windows(t_s, adaptive, frozen, FACTOR * frozen + FLOORS * moving(course.floor_um))


def judge(course: ScenarioRecord) -> Verdict:
    """The verdict on a scenario."""
    s = course.scenario
    dt, percent = s.stage.dt_s, 100.0 / s.range_um
    w = windows(course)
    worst = int(np.argmax(w.ratio))
    # A dwell is judged by its strokes: "before" is the motion before the rest.
    change = round((s.quiet_s[0] if s.quiet_s else s.change_s) / dt)
    begin = round(s.change_s / dt)
    settled = round(SETTLED_S / dt)
    parts = {
        "before": slice(max(0, change - settled), change),
        "first_second": slice(begin, begin + round(1.0 / dt)),
        "settled": slice(-settled, None),
    }
    errors = {
        f"{prefix}{part}_pct": float(np.mean(np.abs(course.error_um[name][where]))) * percent
        for prefix, name in (("", ADAPTIVE), ("frozen_", FROZEN))
        for part, where in parts.items()
    }
    ratio = float(w.ratio[worst])
    return Verdict(
        name=s.name,
        kind=s.kind,
        seed=s.seed,
        text=s.text,
        **errors,
        worst_ratio=ratio,
        worst_s=float(w.t_s[worst]),
        worst_pct=float(w.adaptive_um[worst]) * percent,
        worst_frozen_pct=float(w.frozen_um[worst]) * percent,
        broken_share=float(np.mean(w.ratio > 1.0)),
        floor_pct=float(course.floor_um[-1]) * percent,
        held=ratio <= 1.0,
        verdicts=dict(sorted(course.verdicts.items())),
        counters=course.counters,
    )


def table(verdicts: list[Verdict], markdown: bool = False) -> str:
    """One row per scenario; ``markdown`` for a page."""
    head = (
        "scenario",
        "what happens",
        "before",
        "first 1 s",
        "settled",
        "frozen settled",
        "worst / allowed",
        "at",
        "held",
    )
    rows = [head]
    for v in verdicts:
        rows.append(
            (
                v.name, v.text, f"{v.before_pct:.3f}", f"{v.first_second_pct:.3f}", f"{v.settled_pct:.3f}",
                f"{v.frozen_settled_pct:.3f}", f"{v.worst_ratio:.2f}", f"{v.worst_s:.1f} s", "yes" if v.held else "NO",
            )
        )  # fmt: skip
    if markdown:
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        lines.insert(1, "|" + "---|" * len(head))
        return "\n".join(lines)
    widths = [max(len(row[i]) for row in rows) for i in range(len(head))]
    cells = [
        "  ".join(
            text.ljust(w) if i < 2 else text.rjust(w) for i, (text, w) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    held = sum(v.held for v in verdicts)
    cells.insert(1, "-" * len(cells[0]))
    cells.append(
        f"errors: mean absolute, % of the commanded range; allowed in every {WINDOW_S:g} s: {FACTOR:g} x the frozen "
        f"model's + {FLOORS:g} noise floors"
    )
    cells.append(f"held in {held} of {len(verdicts)} scenarios")
    return "\n".join(cells)
