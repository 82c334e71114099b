"""Problems of a recording, as data: gaps, doubles, dropouts, clipping, values that are not finite, units, swaps.

`check` never raises. A finding has one of three grades: ``note`` (worth knowing), ``warning`` (results suffer) and
``refusal`` (the recording cannot be used; `require_usable` raises).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.masks import runs
from dehyst.sim.recordings.recording import Recording
from dehyst.sim.recordings.repair import dropout_mask, repeat_mask

Severity = Literal["note", "warning", "refusal"]

#: Fewest samples that can be used, and fewest for which a hold-out test means something.
LEAST_SAMPLES, FEW_SAMPLES = 200, 1000
#: Plausible spans of a piezo stage's displacement, µm, and of its command or amplifier, V.
PLAUSIBLE_UM, PLAUSIBLE_V = (0.01, 5000.0), (0.01, 2000.0)
#: Share of samples without a finite value above which a recording is refused.
MOST_NOT_FINITE = 0.2
#: Run of equal extreme readings of a noisy sensor that counts as clipping.
FLAT_RUN = 5
#: Share of repeated values from which on a sensor counts as coarse or at rest; change of the voltage within a run of
#: one reading, as a share of its span, that shows a limit of the sensor.
OFTEN, DRIVEN_SHARE = 0.3, 0.02
#: How much longer than elsewhere a reading must repeat at its limit.
LONGER = 2
#: Sine of the mean lead of the displacement above which the columns may be exchanged. Loops of stages have -0.05 to
#: -0.3; a stage without hysteresis has 0.
LARGEST_LEAD = 0.02
#: Samples without any change that count as a rest of the command.
LEAST_REST = 50
#: Share of a range within which arithmetic rounds.
ROUND_OFF = 1e-9
#: Below this correlation the columns do not form a loop, and are not judged.
LEAST_CORRELATION = 0.8
#: Share of samples with the time of the one before from which the time has too few digits.
OFTEN_DOUBLED = 0.2
#: Longest likely sample time, s: a longer one is a counter, or milliseconds that were taken for seconds.
SLOWEST_DT_S = 0.2


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found in a recording.

    Attributes
    ----------
    kind : fixed name of the problem (``gap``, ``doubled``, ``backwards``, ``jitter``, ``not_finite``, ``dropout``,
        ``clipped``, ``all_zero``, ``constant``, ``line``, ``too_short``, ``swapped``, ``unit``, ``note``).
    severity : ``note``, ``warning`` or ``refusal``.
    column : canonical column, or "" for the whole recording.
    count : number of samples or places.
    at_s : times of the first ten, s.
    message : sentence for people, with the number found and what to do.
    """

    kind: str
    severity: Severity
    column: str
    count: int
    at_s: tuple[float, ...]
    message: str

    def as_dict(self) -> dict[str, Any]:
        """JSON form."""
        return asdict(self) | {"at_s": list(self.at_s)}


def check(recording: Recording) -> list[Finding]:
    """All findings, refusals first. Never raises on data and does not change the recording."""
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
            if finding.count == n:
                continue
        if (finding := _constant(recording, name, values)) is not None:
            found.append(finding)
            values_are_sound &= finding.severity != "refusal"
            continue
        found += _dropouts(recording, name, values)
        found += _flat_ends(recording, name, values)
        found += _plausible(recording, name, values)
    if values_are_sound:
        found += _repeats(recording)
        found += _line(recording) or _swap(recording)
    order = {"refusal": 0, "warning": 1, "note": 2}
    return sorted(found, key=lambda finding: order[finding.severity])


def require_usable(recording: Recording, findings: list[Finding]) -> None:
    """Raise InputError with all refusals among the findings, if there are any."""
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
        gaps = np.flatnonzero((steps > 1.5 * dt) & np.isfinite(steps))
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
        if len(doubled) > OFTEN_DOUBLED * len(steps):
            message += ": the time has too few digits; state the sample time by --rate or --dt-s"
        found.append(Finding("doubled", "warning", "t_s", len(doubled), _places(recording, doubled), message))
    if dt > SLOWEST_DT_S:
        message = (
            f"t_s: one sample each {dt:.4g} s, expected at most {SLOWEST_DT_S:g} s: is the unit of the time right?"
        )
        found.append(Finding("unit", "warning", "t_s", len(t_s), (), message))
    regular = steps[np.isfinite(steps) & (steps >= 0.5 * dt) & (steps <= 1.5 * dt)]
    jitter = float(np.std(regular / dt)) if len(regular) else 0.0
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
    message = f"{name}: {len(bad)} of {len(values)} samples ({100 * share:.2g} %) are not finite numbers"
    if refused:
        message += f", expected at most {100 * MOST_NOT_FINITE:g} %: record again"
    return Finding("not_finite", "refusal" if refused else "warning", name, len(bad), _places(recording, bad), message)


def _constant(recording: Recording, name: str, values: FloatArray) -> Finding | None:
    """A column of one value, from which nothing can be learnt."""
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
        return []  # a command may step to zero and back
    where = np.flatnonzero(dropout_mask(values))
    if not len(where):
        return []
    message = f"{name}: {len(where)} samples drop out to exactly 0, first at {recording.t_s[where[0]]:.4g} s"
    return [Finding("dropout", "warning", name, len(where), _places(recording, where), message)]


def _flat_ends(recording: Recording, name: str, values: FloatArray) -> list[Finding]:
    """Runs of the extreme value: clipping in a noisy sensor, possibly a hold in a command."""
    if name == "temperature_C":
        return []
    found: list[Finding] = []
    finite = np.isfinite(values)
    known = values[finite]
    same = np.abs(np.diff(known)) == 0.0
    # A sensor that often repeats a value is coarse or at rest; equal extremes then prove nothing.
    noisy = len(same) > 0 and float(np.mean(same)) < OFTEN
    top, bottom = float(np.max(known)), float(np.min(known))
    # But where it repeats only its extremes, while the voltage moves, they are its limits, however often.
    inside = (known[1:] != top) & (known[1:] != bottom)
    limited = bool(inside.any()) and float(np.mean(same[inside])) < OFTEN
    # Where the stage turns slowly, a reading of finite resolution repeats at any place: a limit lasts longer.
    elsewhere = runs(same & inside)
    usual = 1 + int(np.max(elsewhere[:, 1] - elsewhere[:, 0], initial=0))
    command = name in ("u_V", "u2_V", "u3_V")
    for which, level in (("top", top), ("bottom", bottom)):
        flat = runs(values == level)
        least = FLAT_RUN if command else max(FLAT_RUN, LONGER * usual)
        long = flat[(flat[:, 1] - flat[:, 0]) >= least] if len(flat) else flat
        if not len(long) or not (command or noisy or (limited and _driven(recording.u_V, long))):
            continue
        count = int(np.sum(long[:, 1] - long[:, 0]))
        what = f"{name}: flat {which} at {level:.5g} in {len(long)} places, {count} samples: "
        what += "holds, or the limit of an output" if command else "the sensor or its converter is at its limit"
        severity: Severity = "note" if command else "warning"
        found.append(Finding("clipped", severity, name, count, _places(recording, long[:, 0]), what))
    return found


def _driven(u_V: FloatArray, runs_of: NDArray[np.int64]) -> bool:
    """Whether the voltage moves in most of the (k, 2) runs: what stands still there is not the stage."""
    span_V = float(np.nanmax(u_V) - np.nanmin(u_V))
    moved_V = [float(np.nanmax(u_V[a:b]) - np.nanmin(u_V[a:b])) for a, b in runs_of if np.isfinite(u_V[a:b]).any()]
    return bool(moved_V) and float(np.median(moved_V)) > DRIVEN_SHARE * span_V


def _plausible(recording: Recording, name: str, values: FloatArray) -> list[Finding]:
    if not name.endswith(("_um", "_V")) or (name == "y_um" and recording.y_unit != "µm"):
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
        f"{recording.t_s[where[0]]:.4g} s: the recorder repeats a value where it missed one"
    )
    return [Finding("doubled", "warning", "", len(where), _places(recording, where), message)]


def _line(recording: Recording) -> list[Finding]:
    if not on_a_line(recording.u_V, recording.y_um):
        return []
    message = (
        "y_um: a straight line of u_V within the digits of both: a target, or a copy, expected the voltage and the "
        "sensor's reading: choose the columns (--column u=... --column y=...)"
    )
    return [Finding("line", "refusal", "y_um", len(recording), (), message)]


def on_a_line(u: FloatArray, y: FloatArray) -> bool:
    """Whether ``y`` (n,) is a straight line of ``u`` (n,) within the smallest steps of both: no sensor's reading."""
    u, y = _centred(u, y)
    if not u.size or np.ptp(u) == 0.0 or np.ptp(y) == 0.0:
        return False
    gain = float(np.sum(u * y) / np.sum(u**2))
    steps = [np.diff(np.unique(np.round(x, 12))) for x in (gain * u, y)]
    digits = sum(float(np.min(step, initial=1.0)) for step in steps)
    return float(np.max(np.abs(y - gain * u))) <= digits + ROUND_OFF


def _centred(u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Both (m,) where both are finite, without their means and over their ranges."""
    good = np.isfinite(u) & np.isfinite(y)
    if not good.any():
        return np.empty(0), np.empty(0)
    # A span below the smallest normal number is none.
    least = float(np.finfo(np.float64).tiny)
    over = [np.asarray(x[good], dtype=np.float64) / max(float(np.ptp(x[good])), least) for x in (u, y)]
    return over[0] - np.mean(over[0]), over[1] - np.mean(over[1])


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


def lead(u: FloatArray, y: FloatArray) -> float:
    """Mean sine of the angle by which ``y`` leads ``u``, (n,) each; negative where y lags, as in a passive stage.

    It is the signed area of the path, closed from its end to its start, over that of a loop without damping, without
    the sign of the gain. Exchanged columns have the same lead with the other sign. Samples that are not finite are left
    out.
    """
    u, y = _centred(u, y)
    area = 0.5 * float(np.sum((np.roll(u, -1) - np.roll(u, 1)) * y))
    # The noise of a sensor adds to its slope: the smoother of the two counts.
    size = float(
        min(np.linalg.norm(u[2:] - u[:-2]) * np.linalg.norm(y), np.linalg.norm(y[2:] - y[:-2]) * np.linalg.norm(u))
    )
    return 2.0 * area / size * float(np.sign(np.sum(u * y))) if size > 0.0 else 0.0


def roughness(x: FloatArray) -> float:
    """Fast noise relative to the range: the median of the fourth differences, in which slow motion vanishes."""
    x = x[np.isfinite(x)]
    if len(x) < 5 or np.ptp(x) == 0.0:
        return 0.0
    return float(np.median(np.abs(np.diff(x, n=4))) / np.sqrt(70.0) / np.ptp(x))


def _rests_under_noise(u: FloatArray, y: FloatArray) -> bool:
    """Whether ``u`` stands exactly still, a hundredth of the time and more, where ``y`` moves by noise alone.

    So a command rests under a sensor. Exchanged, it would be the other way round.
    """
    moved = np.diff(u, prepend=np.nan) != 0.0
    first = np.flatnonzero(moved)
    length = np.diff(np.append(first, u.size))
    rests = [slice(int(a), int(a + n)) for a, n in zip(first, length, strict=True) if n >= LEAST_REST]
    shaken = [r for r in rests if np.mean(np.diff(y[r]) == 0.0) < 0.5 and np.ptp(y[r]) < 0.01 * np.ptp(y)]
    return sum(r.stop - r.start for r in shaken) > 0.01 * u.size


def swapped(u: FloatArray, y: FloatArray) -> Literal["no", "likely", "certain"]:
    """Whether ``u`` and ``y`` look exchanged: a displacement cannot lead its voltage, and only a sensor is noisy."""
    good_u, good_y = _centred(u, y)
    if good_u.size < 3 or np.ptp(good_u) == 0.0 or np.ptp(good_y) == 0.0:
        return "no"
    if abs(float(np.corrcoef(good_u, good_y)[0, 1])) < LEAST_CORRELATION or lead(u, y) < LARGEST_LEAD:
        return "no"
    if _rests_under_noise(good_u, good_y):
        # Beside a recorder whose clock runs fast, readings come before their steps.
        return "no"
    return "certain" if roughness(u) > 3.0 * roughness(y) else "likely"
