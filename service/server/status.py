"""The status of one axis, as JSON; docs/protocol.md tells the fields."""

from __future__ import annotations

from typing import Any, Final

from service.answers.latency import LatencyMeter
from service.intake.intake import Intake
from service.protocol.keys import Keys
from service.protocol.model_classes import stored_kind
from service.protocol.samples import VERSION
from service.runtime.memory import in_use
from service.security.refusals import refusal_counters
from service.server.axis import Axis

SCHEMA: Final = 1
#: What of the learner's diagnostics a status repeats, once a second.
_QUALITY: Final = (
    "recent_rms_error_pct", "rms_error_pct", "share_within_std", "std_V", "gain", "offset_V", "valid", "fallback",
    "window_residual_V", "window_cholesky",
)  # fmt: skip


def axis_status(
    keys: Keys, instance: str, axis: Axis, intake: Intake, latency: LatencyMeter, sample_age_s: float | None
) -> dict[str, Any]:
    """All that a client, an operator or a viewer wants to know of an axis; JSON values only."""
    served, tally = axis.newest, axis.tally
    return {
        "schema": SCHEMA,
        "wire": VERSION,
        "stage": keys.stage,
        "axis": keys.axis,
        "instance": instance,
        "dt_s": axis.dt_s,
        "served": axis.served,
        "learning": axis.config.learn if axis.learning else None,
        "models": {
            name: {"kind": stored_kind(model), "memory_size": model.memory_size}
            for name, model in served.models.items()
        },
        "limits": axis.limits.to_json(),
        "seq": tally.seq,
        "snapshot_seq": served.seq,
        "snapshot_every": axis.config.snapshot_every,
        "snapshots_kept": axis.config.snapshots_kept,
        "sample_age_s": sample_age_s,
        "samples": {
            **tally.samples,
            "dropped": intake.dropped,
            "malformed": intake.malformed,
            "waiting": intake.waiting,
            "learnt": tally.gates.get("learnt", 0),
            "gates": tally.gates,
        },
        "learner": intake.counters,
        "quality": {name: intake.diagnostics[name] for name in _QUALITY if name in intake.diagnostics},
        "competition": intake.standing,
        "retuning": None if axis.retuner is None else axis.retuner.status(),
        "recorder": None if intake.sink is None else intake.sink.counters(),
        "queries": latency.summary(),
        "diagnosis": None if intake.watcher is None else intake.watcher.status(),
        "refused": refusal_counters(),
        "memory": in_use(),
    }
