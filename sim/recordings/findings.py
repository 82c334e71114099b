"""What is wrong with a recording, as data: gaps, doubles, dropouts, flat tops, not-numbers, wrong bases, swaps.

A finding never raises. Three grades: ``note`` (worth knowing), ``warning`` (results suffer), ``refusal`` (nothing
can be learnt from this; :func:`require_usable` raises).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import InputError
from adaptive.types import FloatArray
from sim.recordings.causality import swapped
from sim.recordings.recording import Recording
from sim.recordings.repair import dropout_mask, repeat_mask, runs

Severity = Literal["note", "warning", "refusal"]

#: Fewer samples than this teach nothing; below the second number a hold-out test says little.
LEAST_SAMPLES, FEW_SAMPLES = 200, 1000
#: Ranges beyond which a unit was probably mistaken: µm of a piezo stage, V of its command or its amplifier.
PLAUSIBLE_UM, PLAUSIBLE_V = (0.01, 5000.0), (0.01, 2000.0)
#: Share of samples without a finite value above which a recording is refused.
MOST_NOT_FINITE = 0.2
#: Run of equal extreme readings of a noisy sensor that counts as a flat top.
FLAT_RUN = 5


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found in a recording.

    Attributes
    ----------
    kind : what, by a fixed name (``gap``, ``doubled``, ``backwards``, ``jitter``, ``not_finite``, ``dropout``,
        ``clipped``, ``all_zero``, ``constant``, ``too_short``, ``swapped``, ``unit``, ``note``).
    severity : ``note``, ``warning`` or ``refusal``.
    column : canonical column, or "" for the whole recording.
    count : how many samples or places.
    at_s : where, s, the first ten.
    message : the sentence for people, with the number found and what to do.
    """

    kind: str
    severity: Severity
    column: str
    count: int
    at_s: tuple[float, ...]
    message: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {
            "kind": self.kind,
            "severity": self.severity,
            "column": self.column,
            "count": self.count,
            "at_s": list(self.at_s),
            "message": self.message,
        }


def check(recording: Recording) -> list[Finding]:
    """Everything found in a recording, refusals first. Never raises on data, and never changes it."""
    found = [Finding("note", "note", "", 1, (), note) for note in recording.notes]
    n = len(recording)
    if n < LEAST_SAMPLES:
        message = f"{n} samples: too few to learn from, expected at least {LEAST_SAMPLES}; record longer"
        return [Finding("too_short", "refusal", "", n, (), message), *found]
    if n < FEW_SAMPLES:
        message = f"{n} samples: enough to start with, too few to trust a hold-out error ({FEW_SAMPLES} would do)"
        found.append(Finding("too_short", "warning", "", n, (), message))
    found += _time_base(recording)
    values_are_sound = True
    for name, values in recording.columns().items():
        if name == "t_s":
            continue
        if (finding := _not_finite(recording, name, values)) is not None:
            found.append(finding)
            values_are_sound &= finding.severity != "refusal"
        if (finding := _dull(recording, name, values)) is not None:
            found.append(finding)
            values_are_sound &= finding.severity != "refusal"
            continue
        found += _dropouts(recording, name, values)
        found += _flat_ends(recording, name, values)
        found += _plausible(recording, name, values)
    if values_are_sound:
        found += _repeats(recording)
        found += _swap(recording)
    order = {"refusal": 0, "warning": 1, "note": 2}
    return sorted(found, key=lambda finding: order[finding.severity])


def require_usable(recording: Recording, findings: list[Finding]) -> None:
    """Raise InputError with every refusal among the findings, if there is one."""
    refusals = [finding.message for finding in findings if finding.severity == "refusal"]
    if refusals:
        raise InputError(f"{recording.source or 'recording'}: " + "; ".join(refusals))


def _places(recording: Recording, where: NDArray[np.int64]) -> tuple[float, ...]:
    return tuple(float(t) for t in recording.t_s[where[:10]])


def _time_base(recording: Recording) -> list[Finding]:
    t_s, dt = recording.t_s, recording.dt_s
    found: list[Finding] = []
    bad = np.flatnonzero(~np.isfinite(t_s))
    if len(bad):
        message = f"t_s: {len(bad)} samples without a time"
        found.append(Finding("not_finite", "warning", "t_s", len(bad), (), message))
    with np.errstate(invalid="ignore"):
        steps = np.diff(t_s)
        gaps = np.flatnonzero(steps > 1.5 * dt)
        back = np.flatnonzero(steps < -0.5 * dt)
        doubled = np.flatnonzero((steps >= -0.5 * dt) & (steps < 0.5 * dt))
    if len(gaps):
        lost = int(np.sum(np.rint(steps[gaps] / dt) - 1))
        message = (
            f"{len(gaps)} gaps, {lost} samples missing, the longest {steps[gaps].max():.4g} s at "
            f"{t_s[gaps[np.argmax(steps[gaps])]]:.4g} s"
        )
        found.append(Finding("gap", "warning", "t_s", len(gaps), _places(recording, gaps), message))
    if len(back):
        message = (
            f"time runs backwards at {len(back)} places, first at {t_s[back[0]]:.4g} s: several recordings in one?"
        )
        found.append(Finding("backwards", "warning", "t_s", len(back), _places(recording, back), message))
    if len(doubled):
        message = f"{len(doubled)} samples share their time with the one before, first at {t_s[doubled[0]]:.4g} s"
        found.append(Finding("doubled", "warning", "t_s", len(doubled), _places(recording, doubled), message))
    regular = steps[np.isfinite(steps) & (steps >= 0.5 * dt) & (steps <= 1.5 * dt)]
    jitter = float(np.std(regular) / dt) if len(regular) else 0.0
    if jitter > 0.02:
        message = f"sample times jitter by {100 * jitter:.1f} % of {dt:g} s (one standard deviation): a software clock?"
        found.append(Finding("jitter", "warning", "t_s", len(regular), (), message))
    return found


def _not_finite(recording: Recording, name: str, values: FloatArray) -> Finding | None:
    bad = np.flatnonzero(~np.isfinite(values))
    if not len(bad):
        return None
    share = len(bad) / len(values)
    refused = name in ("u_V", "y_um") and share > MOST_NOT_FINITE
    message = f"{name}: {len(bad)} of {len(values)} samples ({100 * share:.2g} %) are no finite numbers"
    if refused:
        message += f", expected at most {100 * MOST_NOT_FINITE:g} %: record again"
    return Finding("not_finite", "refusal" if refused else "warning", name, len(bad), _places(recording, bad), message)


def _dull(recording: Recording, name: str, values: FloatArray) -> Finding | None:
    """All zeros or one constant: nothing to be learnt from it."""
    finite = values[np.isfinite(values)]
    if not len(finite) or np.ptp(finite) > 0.0:
        return None
    level = float(finite[0])
    kind = "all_zero" if level == 0.0 else "constant"
    needed = name in ("u_V", "y_um")
    what = "zero" if level == 0.0 else f"{level:g}"
    message = f"{name}: every sample is {what}" + (": nothing to learn from; is it the right column?" if needed else "")
    return Finding(kind, "refusal" if needed else "note", name, len(values), (), message)


def _dropouts(recording: Recording, name: str, values: FloatArray) -> list[Finding]:
    if name not in ("y_um", "y2_um", "monitor_V"):
        return []  # a command may well step to zero and back
    where = np.flatnonzero(dropout_mask(values))
    if not len(where):
        return []
    message = f"{name}: {len(where)} samples drop out to exactly 0, first at {recording.t_s[where[0]]:.4g} s"
    return [Finding("dropout", "warning", name, len(where), _places(recording, where), message)]


def _flat_ends(recording: Recording, name: str, values: FloatArray) -> list[Finding]:
    """Runs of one extreme value. In a sensor with noise that is clipping; in a command it may be a hold."""
    if name == "temperature_C":
        return []
    found: list[Finding] = []
    finite = np.isfinite(values)
    same = np.abs(np.diff(values[finite])) == 0.0
    # A sensor that repeats itself often is coarse (or rests): then equal extremes prove nothing.
    noisy = len(same) > 0 and float(np.mean(same)) < 0.3
    command = name in ("u_V", "u2_V", "u3_V")
    for which, level in (("top", float(np.max(values[finite]))), ("bottom", float(np.min(values[finite])))):
        flat = runs(values == level)
        long = flat[(flat[:, 1] - flat[:, 0]) >= FLAT_RUN] if len(flat) else flat
        if not len(long) or (not command and not noisy):
            continue
        count = int(np.sum(long[:, 1] - long[:, 0]))
        what = f"{name}: flat {which} at {level:.5g} in {len(long)} places, {count} samples: "
        what += "holds, or the limit of an output" if command else "the sensor or its converter is at its end"
        severity: Severity = "note" if command else "warning"
        found.append(Finding("clipped", severity, name, count, _places(recording, long[:, 0]), what))
    return found


def _plausible(recording: Recording, name: str, values: FloatArray) -> list[Finding]:
    if not name.endswith(("_um", "_V")):
        return []
    low, high = PLAUSIBLE_UM if name.endswith("_um") else PLAUSIBLE_V
    span = float(np.ptp(values[np.isfinite(values)]))
    if low <= span <= high:
        return []
    unit = name.rsplit("_", 1)[1]
    message = f"{name}: spans {span:.3g} {unit}, expected {low:g} to {high:g} for a piezo stage: is its unit right?"
    return [Finding("unit", "warning", name, len(values), (), message)]


def _repeats(recording: Recording) -> list[Finding]:
    where = np.flatnonzero(repeat_mask(recording))
    if not len(where):
        return []
    message = (
        f"{len(where)} samples repeat the one before exactly while the stage moves, first at "
        f"{recording.t_s[where[0]]:.4g} s: a recorder that doubles what it missed"
    )
    return [Finding("doubled", "warning", "", len(where), _places(recording, where), message)]


def _swap(recording: Recording) -> list[Finding]:
    verdict = swapped(recording.u_V, recording.y_um)
    if verdict == "no":
        return []
    certain = verdict == "certain"
    message = "u_V and y_um look swapped: the voltage follows the displacement" + (
        ", and it is the voltage that carries the sensor's noise: exchange the columns (--column u=... --column y=...)"
        if certain
        else "; check the columns"
    )
    return [Finding("swapped", "refusal" if certain else "warning", "", len(recording), (), message)]
