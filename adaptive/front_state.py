"""What a front holds beside its numbers, as flat entries and back: gates, track, readings held back, frame before."""

from __future__ import annotations

from adaptive.admission import AdmissionState
from adaptive.features import FeatureMap
from adaptive.smoothing import FixedLagSmoother
from adaptive.state import joined, under
from adaptive.surprise import Hold
from adaptive.track import Track
from adaptive.types import StateDict


def parts_to_state(
    gates: AdmissionState, track: Track | None, hold: Hold | None, before: FeatureMap | None
) -> StateDict:
    """All of the parts that are there; copies."""
    parts = {"gates": gates.state_dict()}
    for name, part in (("track", track), ("hold", hold), ("before", before)):
        if part is not None:
            parts[name] = part.state_dict()
    return joined(parts)


def parts_of(
    smoother: FixedLagSmoother, base: FeatureMap, state: StateDict
) -> tuple[AdmissionState, Track | None, Hold | None, FeatureMap | None]:
    """Inverse of ``parts_to_state``. Raises KeyError, TypeError, ValueError or InputError where it does not fit."""
    gates = AdmissionState.from_state(under("gates.", state))
    track, hold, before = (under(f"{name}.", state) for name in ("track", "hold", "before"))
    return (
        gates,
        Track.from_state(smoother, base, track) if track else None,
        Hold.from_state(smoother, base, hold) if hold else None,
        FeatureMap.from_state(before) if before else None,
    )
