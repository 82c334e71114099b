"""The learner over a recording: the same axis as live, the same snapshots to the last bit, and how well it predicted.

Prequential: every block of samples is first predicted, by the snapshot that a controller would have been answered from
(``age_s`` old when the block begins), and then learnt. The prediction is the voltage that makes the measured motion;
the motion is the recording's own, smoothed with zero phase.

After a gap the memory is the learner's, as for a query live. What is predicted from before the gap is not scored.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.online.gates import GAP
from dehyst.adaptive.types import BoolArray, FloatArray, InverseModel
from dehyst.service.answers.guard import Limits
from dehyst.service.config.learner import LearnerSettings
from dehyst.service.config.settings import AxisConfig
from dehyst.service.identification.identifying import motion_of
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.samples import MAX_SEQ, SampleBatch
from dehyst.service.reports.plot_style import envelope, figure, legend, line, save
from dehyst.service.server.axis import Axis
from dehyst.service.storage.model_file import Bundle
from dehyst.service.viewer.colours import ADAPTIVE, DIAGNOSTIC, FROZEN, MEASURED, NOISE_BAND
from dehyst.sim.recordings import Recording, repaired

# --- Replay.

#: Age of the snapshot when the first point that it answers for takes effect, s: asked ahead, plus the samples' way.
AGE_S: Final = 0.06
#: Longest gap, samples, over which what comes after it is still scored; beyond it the longest part is.
LONGEST_BRIDGED: Final = 1_000_000
#: Called with samples done and samples in all.
Progress = Callable[[int, int], None]
#: Called with each snapshot of the learning model as it is published, and its sequence number.
OnSnapshot = Callable[[int, InverseModel], None]


@dataclass(frozen=True, slots=True)
class Replayed:
    """What a replay showed. Arrays of (n,) samples on the recording's own time grid; NaN where nothing is scored.

    Attributes
    ----------
    t_s : time, s. u_V : voltage applied. y_um : reading.
    adaptive_V, frozen_V : predicted less applied voltage, of the learning model and of the one it began as.
    std_V : what the learning model stated as one standard deviation of it.
    gain_um_per_V : mean gain of the recording, by which a voltage error is seen as displacement.
    row_seq, row_t_s, gate : of every row of the recording, in its order: number, time, and index into ``gates`` of what
    was said of it.
    notes : by name, the learner's diagnostics; ``note_t_s`` their times, one a block.
    counters : the learner's own. repaired : what had to be repaired for the scoring.
    """

    t_s: FloatArray
    u_V: FloatArray
    y_um: FloatArray
    adaptive_V: FloatArray
    frozen_V: FloatArray
    std_V: FloatArray
    gain_um_per_V: float
    row_seq: NDArray[np.int64]
    row_t_s: FloatArray
    gate: NDArray[np.int16]
    gates: tuple[str, ...]
    note_t_s: FloatArray
    notes: dict[str, FloatArray]
    counters: dict[str, int] = field(default_factory=dict)
    repaired: tuple[str, ...] = ()


def sequence(recording: Recording) -> NDArray[np.int64]:
    """(n,) sequence numbers: the recorder's own where there are any, else from the times."""
    if recording.seq is not None:
        return recording.seq
    step = (recording.t_s - recording.t_s[np.isfinite(recording.t_s)][0]) / recording.dt_s
    # A sample without a time keeps its place, as does one of a time that no number reaches; the gate for time steps
    # sees that it has none.
    return np.where(np.abs(step) < MAX_SEQ, np.rint(step), np.arange(len(recording))).astype(np.int64)


def feed(axis: Axis, recording: Recording, seq: NDArray[np.int64], start: int, stop: int) -> list[str]:
    """Give rows of a recording to an axis as a message of its stage would have."""
    part = slice(start, stop)
    return axis.handle(SampleBatch(seq[part], recording.t_s[part], recording.u_V[part], recording.y_um[part]))


def replay(
    recording: Recording,
    axis: Axis,
    age_s: float = AGE_S,
    progress: Progress = lambda _done, _all: None,
    on_snapshot: OnSnapshot = lambda _seq, _model: None,
) -> Replayed:
    """Run the recording through ``axis``, which must learn, and score its predictions.

    Raises InputError where the sample times differ by more than a thousandth or nothing of the recording is usable.
    """
    name = axis.config.learn
    if axis.learner is None:
        raise InputError("learn: got an axis that does not learn, expected the name of a model that does")
    if abs(recording.dt_s / axis.dt_s - 1.0) > 1e-3:
        raise InputError(
            f"{recording.source}: sample time: got {recording.dt_s:g} s, expected the model's, {axis.dt_s:g} s: "
            "identify a model at this sample time"
        )
    if not 0.0 <= age_s <= 10.0:
        raise InputError(f"age_s: got {age_s:g}, expected 0 to 10 s")
    seq, whole = sequence(recording), repaired(recording, longest_fill=LONGEST_BRIDGED)
    grid = whole.recording
    motion = motion_of(grid)
    n, size, age = len(grid), axis.config.snapshot_every, math.ceil(age_s / axis.dt_s - 1e-9)
    ends = _row_ends(recording, float(grid.t_s[0]), n, size)
    frozen = axis.newest.models[name]
    # Newest last; the first entry predicts the block.
    ring: deque[_Snapshot] = deque([_Snapshot(-1 - age, frozen, ())])
    memories = [frozen.rest_memory(float(motion[0, 0]))] * 2
    # The first sample after the last gap, and the end of the blocks that take their memory from the learner after it.
    after_gap, until, restarts = 0, 0, 1
    error_V, std_V = np.full((2, n), np.nan), np.full(n, np.nan)
    names: dict[str, int] = {}
    gate = np.zeros(len(recording), dtype=np.int16)
    note_t_s: list[float] = []
    notes: list[dict[str, float]] = []
    row, told = 0, axis.learner.diagnostics
    for block, stop_row in enumerate(ends):
        part = slice(block * size, min(n, (block + 1) * size))
        while len(ring) > 1 and ring[1].stop <= part.start - age:
            ring.popleft()
        known = ring[0].stop > after_gap
        if part.start < until and known:
            way = slice(ring[0].stop, part.start)
            pairs = zip((ring[0].model, frozen), ring[0].memories, strict=True)
            memories = [_carried(model, memory, motion[way], grid.u_V[way]) for model, memory in pairs]
        if part.start < n:
            models = ring[0].model, frozen
            error_V[:, part], std_V[part], memories = _predicted(models, memories, motion[part], grid.u_V[part])
        if part.start < until and not known:
            # Foretold from before the gap: how the stage moved in it was not known.
            error_V[:, part] = np.nan
        before = axis.newest.seq
        for verdict in feed(axis, recording, seq, row, stop_row):
            gate[row] = names.setdefault(verdict, len(names))
            if verdict == GAP and part.start < until:
                until = part.stop + age + size
            row += 1
        began = axis.learner.counters().get("restarts", 0)
        if began > restarts:
            # The learner has lost the track, and takes its memory from the samples that follow.
            restarts, after_gap, until = began, part.start, part.stop + age + size
            error_V[:, part] = np.nan
        if axis.newest.seq != before:
            on_snapshot(axis.newest.seq, axis.newest.models[name])
            tracked = axis.newest.memories[name]
            at_start = axis.learner.memory_for(frozen)
            ring.append(
                _Snapshot(part.stop, axis.newest.models[name], (tracked, tracked if at_start is None else at_start))
            )
        note_t_s.append(float(grid.t_s[min(part.stop, n) - 1]))
        # Some of what a learner tells is more than a number, such as the places of its samples.
        notes.append({key: float(value) for key, value in told().items() if np.ndim(value) == 0})
        progress(row, len(recording))
    error_V[:, ~whole.valid] = np.nan
    keys = sorted(set.intersection(*(set(note) for note in notes)))
    counters = axis.learner.counters()
    return Replayed(
        t_s=grid.t_s,
        u_V=grid.u_V,
        y_um=grid.y_um,
        adaptive_V=error_V[0],
        frozen_V=error_V[1],
        std_V=std_V,
        gain_um_per_V=abs(float(np.polyfit(grid.u_V, grid.y_um, 1)[0])),
        row_seq=seq,
        row_t_s=recording.t_s,
        gate=gate,
        gates=tuple(names),
        note_t_s=np.array(note_t_s),
        notes={key: np.array([note[key] for note in notes]) for key in keys},
        counters=counters,
        repaired=whole.done,
    )


class _Snapshot(NamedTuple):
    """A snapshot as it was published: the next sample, the model, and the memories of it and of the first one."""

    stop: int
    model: InverseModel
    memories: tuple[FloatArray, ...]


def _carried(model: InverseModel, memory: FloatArray, motion: FloatArray, u_V: FloatArray) -> FloatArray:
    """(m,) memory of a model after (k, 3) more points of the motion; the same where there are none."""
    if not u_V.size:
        return memory
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    return model.track(y, v, a, u_V, memory)


def _predicted(
    models: tuple[InverseModel, InverseModel], memories: list[FloatArray], motion: FloatArray, u_V: FloatArray
) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
    """(2, k) errors of two models over (k, 3) points of the motion, (k,) deviations of the first, memories after it."""
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    forward = [model.feedforward(y, v, a, memory) for model, memory in zip(models, memories, strict=True)]
    return np.array([f.u_V - u_V for f in forward]), forward[0].std_V, [f.memory for f in forward]


def _row_ends(recording: Recording, start_s: float, n: int, size: int) -> list[int]:
    """For each block of ``size`` samples of the grid, the row after the last that belongs to it or to one before.

    Rows outside the grid (before the stretch that is scored, or after it) come with its first and after its last block.
    """
    step = (recording.t_s - start_s) / recording.dt_s
    step = np.where(np.isfinite(step), np.rint(step), -np.inf)
    reached = np.maximum.accumulate(step)
    edges = np.arange(size, n + size, size)
    ends = [int(end) for end in np.searchsorted(reached, np.minimum(edges, n) - 0.5, side="left")]
    rows = len(recording)
    while ends[-1] < rows:
        ends.append(min(rows, ends[-1] + size))
    return ends


def covered(replayed: Replayed, part: BoolArray | slice = slice(None)) -> dict[str, float]:
    """Shares of the errors within one and two stated standard deviations; 0.683 and 0.954 are stated."""
    error, std = np.abs(replayed.adaptive_V[part]), replayed.std_V[part]
    scored = np.isfinite(error) & np.isfinite(std)
    if not scored.any():
        return {"one_std": math.nan, "two_std": math.nan}
    ratio = error[scored] / np.maximum(std[scored], 1e-300)
    return {"one_std": float(np.mean(ratio <= 1.0)), "two_std": float(np.mean(ratio <= 2.0))}


def score(error_V: FloatArray, span_V: float, gain_um_per_V: float) -> dict[str, float | None]:
    """Mean absolute, root mean square and largest error in V, in % of the voltage span and seen as µm."""
    size = np.abs(error_V[np.isfinite(error_V)])
    if size.size == 0:
        return dict.fromkeys(f"{key}_{unit}" for key in ("mae", "rmse", "max") for unit in ("V", "pct", "um"))
    values = {"mae": float(size.mean()), "rmse": float(np.sqrt(np.mean(size**2))), "max": float(size.max())}
    scales = {"V": 1.0, "pct": 100.0 / span_V, "um": gain_um_per_V}
    return {f"{key}_{unit}": value * scale for key, value in values.items() for unit, scale in scales.items()}


def summary(replayed: Replayed, span_V: float, bins: int = 20) -> dict[str, Any]:
    """The numbers, for JSON: errors as a whole and in ``bins`` equal parts of time, gates as a whole and likewise."""
    n = replayed.t_s.size
    edges = np.linspace(0, n, min(bins, n) + 1).round().astype(int)
    gain = replayed.gain_um_per_V
    parts = []
    for a, b in itertools.pairwise(edges):
        start_s, stop_s = float(replayed.t_s[a]), float(replayed.t_s[b - 1])
        rows = (replayed.row_t_s >= start_s) & (replayed.row_t_s <= stop_s)
        counts = np.bincount(replayed.gate[rows], minlength=len(replayed.gates))
        parts.append(
            {
                "start_s": start_s,
                "stop_s": stop_s,
                "adaptive": score(replayed.adaptive_V[a:b], span_V, gain),
                "frozen": score(replayed.frozen_V[a:b], span_V, gain),
                "gates": {name: int(count) for name, count in zip(replayed.gates, counts, strict=True) if count},
            }
        )
    total = np.bincount(replayed.gate, minlength=len(replayed.gates))
    return {
        "schema": 1,
        "samples": int(replayed.gate.size),
        "scored": int(np.isfinite(replayed.adaptive_V).sum()),
        "span_V": span_V,
        "gain_um_per_V": gain,
        "adaptive": score(replayed.adaptive_V, span_V, gain),
        "frozen": score(replayed.frozen_V, span_V, gain),
        "within_stated_std": covered(replayed),
        "gates": {name: int(count) for name, count in zip(replayed.gates, total, strict=True)},
        "counters": replayed.counters,
        "repaired": list(replayed.repaired),
        "over_time": parts,
    }


# --- The axis that a replay runs: the configuration's own, or one around settings of the learner alone.


DEFAULT_LEARN: Final = "lssvm_adaptive"
#: Nothing is commanded in a replay; limits so far out that they refuse nothing, unless the settings set their own.
_FAR: Final = 1e3


def axis_config(found: LearnerSettings, path: Path, bundle: Bundle, learn: str | None) -> AxisConfig:
    """Configuration of the axis for a model file. Raises InputError where the model to learn is not in it."""
    if found.axis is not None:
        config = replace(found.axis, model=path, learn=learn or found.axis.learn)
    else:
        volts = [abs(u) for u in (bundle.meta.u_min_V, bundle.meta.u_max_V) if u is not None]
        far = _FAR * max([1.0, *volts])
        name = learn or DEFAULT_LEARN
        config = AxisConfig(
            "replay", path, Limits(-far, far, float("inf")), served=name, learn=name, learner=found.settings
        )
    if config.learn not in bundle.models:
        raise FieldError("--learn", repr(config.learn), f"one of the models in {path}: {', '.join(bundle.models)}")
    if config.served not in bundle.models:
        config = replace(config, served=config.learn)
    return config


# --- What was said of every row of a replayed recording, as a file: one line a row, in the recording's order.


COLUMNS: Final = ("seq", "t_s", "decision")


def write_gates(path: Path, replayed: Replayed) -> None:
    """Write ``gates.csv``. Times as they were recorded, to the last bit; ``nan`` where a row had none. Raises OSError.

    Rows and not samples of the grid: what was doubled, late or without a time was decided on too.
    """
    r = replayed
    with path.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(COLUMNS)
        decisions = (r.gates[index] for index in r.gate.tolist())
        lines.writerows(zip(r.row_seq.tolist(), r.row_t_s.tolist(), decisions, strict=True))


# --- Pictures of a replay: errors of the prediction over time, the learner's diagnostics, and its answers to samples.

#: Diagnostics of the learner that are drawn, in this order, where it has them.
SHOWN = (("gain", "gain"), ("frame_offset_um", "offset of the frame, µm"), ("offset_V", "offset, V"))


def _moving(values: FloatArray, span: int) -> FloatArray:
    """(n,) mean of the finite values over the last ``span`` samples; NaN if there are none."""
    good = np.isfinite(values)
    total, count = np.cumsum(np.where(good, values, 0.0)), np.cumsum(good)
    total[span:], count[span:] = total[span:] - total[:-span], count[span:] - count[:-span]
    mean: FloatArray = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def draw_errors(path: Path, title: str, replayed: Replayed, span_V: float, window_s: float) -> None:
    """Motion, errors with the stated uncertainty, their moving mean, and the learner's diagnostics."""
    r, percent = replayed, 100.0 / span_V
    dt = float(np.median(np.diff(r.t_s)))
    shown = [(key, label) for key, label in SHOWN if key in r.notes]
    heights = (0.8, 1.4, 1.4, *[0.6] * len(shown))
    drawn, axes = figure(len(heights), 1, (11.0, 8.0 + 1.3 * len(shown)), title, sharex=True, height_ratios=heights)
    grid = axes[:, 0]
    top, middle, bottom = grid[:3]
    line(top, r.t_s, r.y_um, color=MEASURED, lw=0.6)
    top.set_ylabel("reading, µm")
    line(middle, r.t_s, r.frozen_V * percent, color=FROZEN, lw=0.6, label="not adapting")
    t_std, std = envelope(r.t_s, r.std_V * percent)
    middle.fill_between(t_std, -2.0 * std, 2.0 * std, color=NOISE_BAND, alpha=0.5, lw=0, label="± 2 stated deviations")
    line(middle, r.t_s, r.adaptive_V * percent, color=ADAPTIVE, lw=0.6, label="adapting")
    shares = covered(r)
    middle.set_title(
        f"errors within one stated deviation: {100 * shares['one_std']:.0f} % (68 stated), "
        f"within two: {100 * shares['two_std']:.0f} % (95 stated)",
        fontsize=9,
    )
    middle.set_ylabel("predicted less applied,\n% of voltage span")
    legend(middle, ncols=3, loc="upper right")
    span = max(1, round(window_s / dt))
    for values, colour, label in (
        (r.frozen_V, FROZEN, "not adapting"),
        (r.adaptive_V, ADAPTIVE, "adapting"),
    ):
        running = np.maximum(_moving(np.abs(values), span) * percent, 1e-5)
        line(bottom, r.t_s, running, color=colour, lw=1.3, label=label)
    bottom.set_yscale("log")
    bottom.grid(True, which="both", alpha=0.25)
    bottom.set_ylabel(f"mean |error| of the last {window_s:g} s,\n% of voltage span")
    legend(bottom, loc="upper right")
    for axis, (key, label) in zip(grid[3:], shown, strict=True):
        axis.plot(r.note_t_s, r.notes[key], color=DIAGNOSTIC, lw=1.0)
        axis.set_ylabel(label, fontsize=8)
    for axis in grid:
        axis.margins(x=0)
    grid[-1].set_xlabel("time, s")
    save(drawn, path)


def draw_gates(path: Path, title: str, replayed: Replayed, bins: int = 300) -> None:
    """For each kind of answer of the learner the share of samples that got it, over time."""
    r = replayed
    t_s = r.row_t_s
    finite = np.isfinite(t_s)
    low, high = float(t_s[finite].min()), float(t_s[finite].max())
    edges = np.linspace(low, high if high > low else low + 1.0, min(bins, max(2, t_s.size // 5)) + 1)
    total = np.histogram(t_s[finite], edges)[0]
    counts = np.bincount(r.gate, minlength=len(r.gates))
    order = sorted(range(len(r.gates)), key=lambda i: (r.gates[i] in ("learnt", "passed"), counts[i]), reverse=True)
    size = (11.0, 1.2 + 0.75 * len(order))
    drawn, grid = figure(len(order), 1, size, f"{title}: the learner's answers", sharex=True, sharey=True)
    for axes, index in zip(grid[:, 0], order, strict=True):
        seen = np.histogram(t_s[finite & (r.gate == index)], edges)[0]
        share = np.divide(seen, total, out=np.zeros(seen.shape), where=total > 0)
        axes.stairs(share, edges, fill=True, color=ADAPTIVE if r.gates[index] == "learnt" else DIAGNOSTIC)
        axes.set_ylabel(f"{r.gates[index]}\n{counts[index]}", rotation=0, ha="right", va="center", fontsize=8)
        axes.set_ylim(0.0, 1.0)
        axes.set_yticks([])
        axes.margins(x=0)
    grid[-1, 0].set_xlabel("time, s")
    save(drawn, path)
