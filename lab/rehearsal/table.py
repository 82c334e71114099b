"""A rehearsal as a table: a row an event, the learning model beside the frozen one."""

from __future__ import annotations

import math
from collections.abc import Sequence

from lab.rehearsal.events import SENSOR
from lab.rehearsal.outcome import LARGE_PCT, SENSOR_FACTOR, SENSOR_PCT, Outcome
from lab.rehearsal.rehearsing import Rehearsal

#: Time above 5 % of the range that is called large, s.
LARGE_S = 0.1

HEAD = (
    "what happens", "before", "first 1 s", "1 to 4 s", "settled", "frozen settled", "worst 0.5 s / frozen",
    "named after", "remarks",
)  # fmt: skip


def row(result: Outcome) -> tuple[str, ...]:
    """The cells of a run."""
    one, other = result.adaptive, result.frozen
    text = f"{result.text} (left out)" if result.left_out else result.text
    named = f"{result.named_s:.2f} s" if math.isfinite(result.named_s) else "not" if result.category == SENSOR else "-"
    errors = (one.before_pct, one.first_second_pct, one.then_pct, one.settled_pct, other.settled_pct)
    return (
        text, *(f"{value:.3f}" for value in errors), f"{result.worst_ratio:.2f}", named, ", ".join(remarks(result))
    )  # fmt: skip


def remarks(result: Outcome) -> list[str]:
    """What of a run is not as it should be, and what the axis called wrong; in words."""
    one = result.adaptive
    found = []
    if one.ends_at_rail:
        found.append("ENDS AT A RAIL")
    if one.large_s > LARGE_S:
        found.append(f"above {LARGE_PCT:g} % for {one.large_s:.2f} s")
    if result.category == SENSOR and result.sensor_excess > 1.0:
        found.append(f"steered by a wrong sensor: {result.sensor_excess:.2g} times what is in order")
    names = [trouble.name for trouble in result.troubles]
    return [*found, *(f"said: {name}" for name in dict.fromkeys(names))]


def table(rehearsal: Rehearsal, markdown: bool = False) -> str:
    """All runs, for people; ``markdown`` for a page."""
    rows = [HEAD, *(row(run.outcome) for run in rehearsal.runs)]
    if markdown:
        lines = ["| " + " | ".join(cells) + " |" for cells in rows]
        return "\n".join([lines[0], "|" + "---|" * len(HEAD), *lines[1:]])
    widths = [max(len(cells[i]) for cells in rows) for i in range(len(HEAD))]
    lines = ["  ".join(_aligned(cells, widths)).rstrip() for cells in rows]
    known = rehearsal.identified
    lines.insert(1, "-" * len(lines[0]))
    lines += [
        "errors: mean absolute, % of the commanded range; identified: "
        f"{known.low_um:.4g} to {known.high_um:.4g} µm, off by {known.heldout_mae_pct:.3f} % of the voltage span",
        "named after: motion, s, until the axis said that the sensor is wrong; in order is then an error up to "
        f"{SENSOR_PCT:g} % or {SENSOR_FACTOR:g} times the frozen model's",
    ]
    return "\n".join(lines)


def _aligned(cells: Sequence[str], widths: Sequence[int]) -> list[str]:
    last = len(cells) - 1
    pairs = enumerate(zip(cells, widths, strict=True))
    return [cell.ljust(width) if i in (0, last) else cell.rjust(width) for i, (cell, width) in pairs]
