"""The status of one axis, as JSON; docs/protocol.md lists the fields."""

from __future__ import annotations

import time
from typing import Any, Final

from service.protocol.keys import Keys
from service.protocol.model_classes import stored_kind
from service.protocol.samples import VERSION
from service.runtime.memory import in_use
from service.security.refusals import refusal_counters
from service.server.axis_loop import AxisLoop
from service.server.latency import LatencyMeter
from service.server.learner_state import fingerprint

SCHEMA: Final = 1
#: Fields of the learner's diagnostics that a status repeats.
_QUALITY: Final = (
    "recent_rms_error_pct", "rms_error_pct", "share_within_std", "std_V", "gain", "offset_V", "valid", "fallback",
    "window_residual_V", "window_cholesky",
)  # fmt: skip


def axis_status(
    keys: Keys,
    instance: str,
    loop: AxisLoop,
    latency: LatencyMeter,
    *,
    role: str = "primary",
    epoch: int = 0,
    synced: bool = True,
    stale: bool = False,
    checkpoints: dict[str, Any] | None = None,
    operations: dict[str, int] | None = None,
) -> dict[str, Any]:
    """The fields for clients, operators and viewers; JSON values only. From any thread.

    ``checkpoints``, ``operations`` : their counters.
    """
    axis, queue, figures = loop.axis, loop.queue, loop.figures
    # One snapshot and one set of counts for all fields: others may come meanwhile.
    served, counts, learn = axis.newest, axis.counts, axis.config.learn
    return {
        "schema": SCHEMA,
        "wire": VERSION,
        "stage": keys.stage,
        "axis": keys.axis,
        "instance": instance,
        "dt_s": axis.dt_s,
        "served": served.default,
        "learning": learn if axis.learning else None,
        "models": {
            name: {"kind": stored_kind(model), "memory_size": model.memory_size}
            for name, model in served.models.items()
        },
        "limits": axis.limits.to_json(),
        "seq": counts.seq,
        "snapshot_seq": served.seq,
        "snapshot_every": axis.config.snapshot_every,
        "snapshots_kept": axis.config.snapshots_kept,
        "sample_age_s": queue.age_s(time.monotonic()),
        "samples": {
            **counts.samples,
            "dropped": queue.dropped,
            "malformed": queue.malformed,
            "waiting": queue.waiting,
            "learnt": counts.gates.get("learnt", 0),
            "gates": counts.gates,
        },
        "learner": figures.counters,
        "quality": {name: figures.diagnostics[name] for name in _QUALITY if name in figures.diagnostics},
        "competition": figures.standing,
        "retuning": None if loop.tuner is None else loop.tuner.status(),
        "recorder": None if loop.sink is None else loop.sink.counters(),
        "queries": latency.summary(),
        "diagnosis": None if loop.watcher is None else loop.watcher.status(),
        "refused": refusal_counters(),
        "memory": in_use(),
        "role": role,
        "epoch": epoch,
        "synced": synced,
        "stale": stale,
        "trouble": served.trouble,
        "trust": served.trust,
        "stand_in": served.stand_in,
        "frozen": axis.frozen,
        "checkpoints": checkpoints,
        "operations": operations,
        "fingerprint": fingerprint(served.models[learn]) if learn else "",
    }
