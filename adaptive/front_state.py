"""What a front holds beside its numbers, as flat entries and back."""

from __future__ import annotations

from adaptive.admission import AdmissionState
from adaptive.features import FeatureMap
from adaptive.following import Following
from adaptive.hypotheses import Hold
from adaptive.smoothing import FixedLagSmoother
from adaptive.snapshot import LssvmInverse
from adaptive.state import joined, under
from adaptive.track import Track
from adaptive.trial import Trial
from adaptive.types import StateDict


def parts_to_state(
    gates: AdmissionState,
    track: Track | None,
    hold: Hold | None,
    trial: Trial | None,
    before: FeatureMap | None,
    following: Following,
) -> StateDict:
    """All of the parts that are there; copies."""
    parts = {"gates": gates.state_dict(), "following": following.state_dict()}
    for name, part in (("track", track), ("hold", hold), ("trial", trial), ("before", before)):
        if part is not None:
            parts[name] = part.state_dict()
    return joined(parts)


def parts_of(
    smoother: FixedLagSmoother, model: LssvmInverse, state: StateDict
) -> tuple[AdmissionState, Track | None, Hold | None, Trial | None, FeatureMap | None, Following]:
    """Inverse of ``parts_to_state``; ``model`` is the identified one.

    Raises KeyError, TypeError, ValueError or InputError where it does not fit.
    """
    gates = AdmissionState.from_state(under("gates.", state))
    track, hold, trial, before = (under(f"{name}.", state) for name in ("track", "hold", "trial", "before"))
    return (
        gates,
        Track.from_state(smoother, model.features, track) if track else None,
        Hold.from_state(hold) if hold else None,
        Trial.from_state(trial, model) if trial else None,
        FeatureMap.from_state(before) if before else None,
        Following.from_state(under("following.", state)),
    )
