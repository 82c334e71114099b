"""What a competition tells of itself: the standing, counters and diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from baselines.competition import Competition


def standing(c: Competition) -> dict[str, Any]:
    """Champion, changes, and the rms error of each contestant in V and in percent of the span."""
    table = {
        name: {
            "rms_V": c._judging.rms_V(i),
            "rms_pct": c._judging.rms_V(i) * 100.0 / c._span_V,
            "scored": round(c._judging.scores[i].weight, 4),
            "failed": c._out[i],
        }
        for i, name in enumerate(c.names)
    }
    return {"champion": c.champion, "changes": c._succession.changes, "contestants": table}


def change(c: Competition, errors_V: Sequence[float], before: int, why: str) -> str:
    """That the champion is another than ``before``, with the rms errors (k,), V, by which it was chosen, and why."""
    after, old = (f"{c.names[i]} ({errors_V[i] / c._span_V:.3%} rms)" for i in (c._succession.champion, before))
    return f"{after} is served in place of {old}: {why}"


def counters(c: Competition) -> dict[str, int]:
    """The favourite's, and the competition's own."""
    own = {"champion_changes": c._succession.changes, "contestants_failed": sum(c._out)}
    return {**c.favourite.counters(), **own}


def diagnostics(c: Competition) -> dict[str, Any]:
    """The favourite's, with ``competition_NAME_rms_pct`` of each contestant and the champion's index."""
    told: dict[str, Any] = getattr(c.favourite, "diagnostics", dict)()
    percent = 100.0 / c._span_V
    own = {f"competition_{name}_rms_pct": c._judging.rms_V(i) * percent for i, name in enumerate(c.names)}
    return {**told, **own, "competition_champion": float(c._succession.champion)}
