"""What a learner tells of itself: counters, and what a viewer draws."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from adaptive.state import prefixed

if TYPE_CHECKING:
    from adaptive.learner import Learner


def counters(learner: Learner) -> dict[str, int]:
    """Samples by outcome, and events. A copy."""
    parts = learner.parts
    drift = parts.filter.state
    events = {
        "restarts": parts.front.restarts,
        "jumps": parts.front.jumps,
        "jumps_undone": parts.front.undone,
        "trials": parts.front.trials,
        **parts.events,
    }
    return {
        **parts.counters,
        **events,
        "filter_updates": drift.updates,
        "bursts": drift.bursts,
        **prefixed("window_", parts.window.counters()),
    }


def diagnostics(learner: Learner) -> dict[str, Any]:
    """Errors in V and in percent of the voltage span, gain and offset, the window's samples.

    ``gain`` is the stage's, relative to the identified model: that of the frame and of the linear part together.
    """
    parts, base = learner.parts, learner.base
    j, front, percent = parts.judgement, parts.front, 100.0 / base.span_V
    estimate = parts.filter.beta
    now, before = estimate[1:], base.beta[1:]
    along = float(now @ before)
    window_y_um, window_v_um_per_s = front.served.motion_of(parts.window.arrays()[0])
    return {
        "error_V": j.error_V,
        "rms_error_pct": float(np.sqrt(j.long_V2)) * percent,
        "recent_rms_error_pct": float(np.sqrt(j.short_V2)) * percent,
        "frozen_rms_error_pct": float(np.sqrt(j.frozen_V2)) * percent,
        "share_within_std": j.inside / max(1, j.judged),
        "gain": front.served.gain * (float(before @ before) / along if along > 0.0 else 1.0),
        "frame_gain": front.served.gain,
        "frame_offset_um": front.served.offset_um,
        "offset_V": float(estimate[0] - base.beta[0]),
        "u_V": front.gates.u_V,
        "std_V": float(np.sqrt(j.variance_V2)),
        "window_samples": float(len(parts.window)),
        "window_residual_V": parts.window.residual_V,
        "window_cholesky": float(parts.window.form == "cholesky"),
        "valid": float(j.valid),
        "fallback": float(j.fallback),
        "frozen": float(learner.frozen),
        "lag_s": front.smoother.config.lag * base.dt_s,
        "window_y_um": window_y_um.tolist(),
        "window_v_um_per_s": window_v_um_per_s.tolist(),
    }
