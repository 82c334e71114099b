"""Golden replay: fingerprints of learner, competition, snapshots, wire, checkpoints and replay on fixed recordings.

The test runs four recordings through a served axis and compares the results with ``golden.json``. It does not judge
whether a result is good. It only tells that a result has changed.

Recordings
----------
demo : 6 s of the demonstration's stage at 1 kHz; after 3 s the gain drops by 6 % and the moved mass doubles.
contest : the same samples, with a learner that starts 15 % wrong; the champion changes twice.
faulty : 12 s with every fault that the soak test injects into samples, then wild numbers and a restarted stage.
measured : 4000 samples of a measured stack actuator at 200 Hz; skipped where ``DEHYST_DATA`` has none.

What must match
---------------
Counts, names, flags, and bytes that hold no computed floats must match exactly. The recordings are chosen so that no
decision is a close call: in 12 runs of each with readings perturbed by 1e-13 (relative, random sign), no count changed.
Other numbers are stored with 6 digits. The largest change in these runs was 1.6e-9, relative to the largest number of
its list. The tolerance is ten times that (1.6e-8) plus the rounding of the file (5e-6): 5.02e-6. Measure again with
``--sensitivity 12``. Two runs on one machine (restored, replayed, other messages) must match to the last bit.

After a refactoring, change only the adapter section. After a wanted change of results, renew the file with
``python -m tests.golden.test_golden --write``; it prints what has changed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from numpy.typing import NDArray

# ---------------------------------------------------------------------------------------------------------------------
# Adapter: the only section that names the product. Change the imports and these functions after files have moved;
# leave everything below the next line as it is.
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.types import InverseModel
from dehyst.baselines import fit_linear, fit_mpi
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.model import decode_model, encode_model
from dehyst.service.protocol.query import (
    Answer,
    FeedforwardQuery,
    Pending,
    decode_query,
    decode_reply,
    encode_query,
    encode_reply,
)
from dehyst.service.protocol.samples import (
    SampleBatch,
    decode_samples,
    encode_command,
    encode_reference,
    encode_samples,
    joined,
)
from dehyst.service.replay import covered, replay
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.stage_node.faults import CHANGE, Fault, Injector
from dehyst.service.storage.checkpoint import CheckpointFolder, CheckpointMeta, restore_newest
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.sim.recordings import ColumnMap, Recording, read, repaired
from dehyst.sim.signals.voltages import multitone, training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

LEARNER: Final = "lssvm_adaptive"
CHAMPION: Final = "auto"
Floats = NDArray[np.float64]
Model = InverseModel
Batch = SampleBatch
AnAxis = Axis


def stage_readings(u_V: Floats, seed: int, changes: tuple[tuple[float, dict[str, float]], ...] = ()) -> Floats:
    """Readings, µm, of the stage of the demonstration, at 1 kHz; ``changes``: (time in s, new parameters)."""
    stage = Stage(preset("rich", seed=seed, changes=changes))
    return np.asarray(stage.run(stage.initial_state(), u_V)[0], dtype=np.float64)


def stage_fault_kinds() -> tuple[str, ...]:
    """Faults of readings and messages that the soak injects."""
    # By name, so that a fault that is added later does not change what is pinned.
    return "nan", "spike", "freeze", "saturate", "offset", "gap", "duplicate", "reorder", "clock"


def stage_messages(u_V: Floats, seed: int, faults: Mapping[int, Sequence[Spoil]], size: int) -> list[Batch]:
    """What the stage sends while it suffers ``faults`` (by first sample, a multiple of ``size``)."""
    stage = Stage(preset("rich", seed=seed))
    state = stage.initial_state()

    def change(values: dict[str, float]) -> None:
        nonlocal state
        state = stage.with_changes(state, values)

    injector, sent = Injector(DT_S, change), list[Batch]()
    for first in range(0, u_V.size, size):
        for spoil in faults.get(first, ()):
            if spoil.parameter:
                injector.add(Fault(CHANGE, values=((spoil.parameter, spoil.value),)))
            else:
                injector.add(Fault(spoil.kind, spoil.samples * DT_S, spoil.value))
        seq = np.arange(first, min(first + size, u_V.size), dtype=np.int64)
        y = [injector.reading(k, stage.step(state, float(u_V[k]))[0]) for k in seq.tolist()]
        rows = (seq, times(seq), u_V[seq], np.array(y, dtype=np.float64))
        sent += [SampleBatch(*message) for message in injector.deliver(rows)]
    return sent + [SampleBatch(*message) for message in injector.flush()]


def measured(file: str) -> Batch:
    """A recording of the measured stack, on a whole time grid."""
    found = repaired(read(data_folder() / "picma_stack" / file, ColumnMap(sensor_late=1))).recording
    return SampleBatch(np.arange(len(found), dtype=np.int64), found.t_s, found.u_V, found.y_um)


def identified(u_V: Floats, y_um: Floats, dt_s: float, learner_scale: float) -> Bundle:
    """The models that the axis starts from: learner, Prandtl-Ishlinskii, linear. No tuning: that takes seconds.

    ``learner_scale``: factor of the readings that the learner's model is identified from.
    """
    config = IdentifyConfig(tune=False, n=200)
    models: dict[str, InverseModel] = {
        LEARNER: identify_lssvm(u_V, learner_scale * y_um, dt_s, config=config, name=LEARNER)[0],
        "mpi": fit_mpi(u_V, y_um, dt_s)[0],
        "linear": fit_linear(u_V, y_um, dt_s)[0],
    }
    span = float(np.ptp(y_um))
    low, high = float(y_um.min()) - 0.1 * span, float(y_um.max()) + 0.1 * span
    return Bundle(models, BundleMeta("demo", "x", dt_s, y_min_um=low, y_max_um=high))


def new_axis(bundle: Bundle, limits_V: tuple[float, float, float], learner: dict[str, Any]) -> Axis:
    """A fresh axis with its competition, as ``dehyst serve`` makes it; limits: lowest, highest V, V/s."""
    config = AxisConfig("x", Path("x.npz"), Limits(*limits_V), learner={"window": 200, **learner})
    return load_axis("demo", config, bundle=bundle)


def write_checkpoint(axis: Axis, folder: Path) -> None:
    """Write the axis' state as the service does."""
    meta = CheckpointMeta("demo", "x", axis.dt_s, axis.handled_seq, axis.sequence.received, models=axis.identified)
    CheckpointFolder(folder, "demo", "x", axis.dt_s, axis.identified, 4).write(meta, axis.state_dict())


def read_checkpoint(axis: Axis, folder: Path) -> bool:
    """Let a fresh axis go on from the newest checkpoint."""
    kept = CheckpointFolder(folder, "demo", "x", axis.dt_s, axis.identified, 4)
    return restore_newest(axis, kept) is not None


def checkpoint_entries(folder: Path, axis: Axis) -> tuple[dict[str, Any], dict[str, Any]]:
    """(meta, state) of the newest checkpoint as it was read back."""
    kept = CheckpointFolder(folder, "demo", "x", axis.dt_s, axis.identified, 4)
    meta, state = kept.read(kept.numbers()[0])
    told = {key: getattr(meta, key) for key in ("stage", "axis", "dt_s", "seq", "samples", "schema", "units")}
    return told, state


def foretold(axis: Axis, batch: Batch) -> tuple[dict[str, float], dict[str, int]]:
    """Replay the samples through a fresh axis: mean errors in V with stated shares, and counts of verdicts."""
    recording = Recording(batch.t_s, batch.u_V, batch.y_um, axis.dt_s, source="golden", seq=batch.seq)
    done = replay(recording, axis)
    errors = {"adaptive": done.adaptive_V, "frozen": done.frozen_V, "std": done.std_V}
    means = {f"{name}_mean_V": float(np.nanmean(np.abs(values))) for name, values in errors.items()}
    counts = np.bincount(done.gate, minlength=len(done.gates))
    return {**means, **covered(done)}, {name: int(n) for name, n in zip(done.gates, counts, strict=True)}


def standing(axis: Axis) -> dict[str, Any]:
    """Champion, changes, and each contestant's rms_V, scored, failed."""
    learner: Any = axis.learner
    told: dict[str, Any] = learner.standing()
    return told


def learner_counters(axis: Axis) -> dict[str, int]:
    """What the learner counted: verdicts and events, without the counts that depend on the processor's rounding."""
    learner: Any = axis.learner
    return {name: count for name, count in learner.counters().items() if name not in ROUNDING}


def model_payload(axis: Axis, name: str) -> bytes:
    """The wire payload of a served model."""
    model, seq, memory = axis.model(name)
    return encode_model(name, model, seq, memory, axis.safety(name))


# End of the adapter.
# ---------------------------------------------------------------------------------------------------------------------

GOLDEN: Final = Path(__file__).with_name("golden.json")
DT_S: Final = 1e-3
#: Samples a message.
MESSAGE: Final = 20
NAMES: Final = ("demo", "contest", "faulty", "measured")
REPLY_HEAD_BYTES: Final = 24
#: Relative size of the perturbation by which ``--sensitivity`` measures.
JITTER: Final = 1e-13
#: Digits of the numbers in the file.
DIGITS: Final = 6
#: Largest change under the perturbation, times ten, plus the rounding of the file.
TOLERANCE: Final = 10 * 1.6e-9 + 5e-6
#: Largest difference of a count; the perturbation changed none.
COUNT_SLACK: Final = 0
#: Counts of small residuals and what mends them: other processors give others.
ROUNDING: Final = ("window_residuals_exceeded", "window_refinements")


@dataclass(frozen=True, slots=True)
class Spoil:
    """A fault of the stage: its kind and length in samples, or a ``parameter`` that becomes ``value``."""

    kind: str = ""
    samples: int = 0
    value: float = 0.0
    parameter: str = ""


@dataclass(frozen=True, slots=True)
class Tape:
    """A recording: (u_V, y_um) to identify from, messages to learn from, and the settings of the axis.

    ``checkpoint_at``: the message after which a checkpoint is written.
    ``exact_volts``: the voltages hold no computed floats, so the bytes of the whole payload are the same everywhere.
    ``learner_scale``: by how much the model that the learner starts from is wrong.
    """

    name: str
    dt_s: float
    u_V: Floats
    y_um: Floats
    messages: tuple[Batch, ...]
    limits_V: tuple[float, float, float]
    learner: dict[str, Any]
    checkpoint_at: int
    exact_volts: bool = False
    learner_scale: float = 1.0


@dataclass(slots=True)
class Result:
    """What one run pins, and the digests that two runs of the same machine must share."""

    pinned: dict[str, Any]
    ends: dict[str, dict[str, str]]
    restored: bool
    seconds: float


def data_folder() -> Path:
    """Where measured data are looked for."""
    return Path(os.environ.get("DEHYST_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data"))


def times(seq: NDArray[np.int64]) -> Floats:
    """Times of the samples with these numbers, s; the same bits on every machine."""
    return np.asarray(seq * DT_S, dtype=np.float64)


def digest(data: bytes) -> str:
    """A short digest of bytes."""
    return hashlib.blake2b(data, digest_size=8).hexdigest()


# ---- recordings


def tape(name: str, jitter: int = 0) -> Tape:
    """The recording called ``name``; ``jitter``: seed of a perturbation of all readings, 0 for none."""
    made = {"demo": demo_tape, "contest": contest_tape, "faulty": faulty_tape, "measured": measured_tape}[name]()
    if not jitter:
        return made
    rng = np.random.default_rng(jitter)
    # Equal readings stay equal: a stuck sensor repeats its reading on every machine.
    known = np.unique(np.concatenate([made.y_um, *(message.y_um for message in made.messages)]))
    factor = 1.0 + JITTER * rng.choice((-1.0, 1.0), known.size)

    def moved(y_um: Floats) -> Floats:
        return np.asarray(y_um * factor[np.searchsorted(known, y_um)], dtype=np.float64)

    messages = tuple(replace(message, y_um=moved(message.y_um)) for message in made.messages)
    return replace(made, y_um=moved(made.y_um), messages=messages)


def split(batch: Batch, size: int) -> Iterator[Batch]:
    """The samples in messages of ``size``."""
    for first in range(0, len(batch), size):
        yield batch.where((np.arange(len(batch)) >= first) & (np.arange(len(batch)) < first + size))


def demo_tape() -> Tape:
    """Six seconds of the demonstration's stage; after three the gain drops by 6 % and the moved mass doubles."""
    u_V = training_input(DT_S, 6.0)[1]
    drive_V = multitone(6.0, DT_S, seed=20)[1]
    drive_V[:500] *= np.linspace(0.0, 1.0, 500)
    change = {"gain_drift.gain": -0.06, "resonance.payload_ratio": 1.0}
    y_um = stage_readings(drive_V, 20, ((3.0, change),))
    seq = np.arange(drive_V.size, dtype=np.int64)
    whole = Batch(seq, times(seq), drive_V, y_um)
    messages = tuple(split(whole, MESSAGE))
    return Tape("demo", DT_S, u_V, stage_readings(u_V, 20), messages, (0.0, 10.0, 4000.0), {}, len(messages) // 2)


def contest_tape() -> Tape:
    """The samples of ``demo`` with a learner that starts 15 % wrong: another contestant is champion for a while.

    The checkpoint is written while it is.
    """
    return replace(demo_tape(), name="contest", learner_scale=1.15, checkpoint_at=100)


def faulty_tape() -> Tape:
    """The stage with every fault that the soak test injects, then wild numbers, then a stage that counts anew."""
    rng = np.random.default_rng(7)
    values = {"spike": 30.0, "offset": 5.0, "saturate": 42.0, "clock": -3600.0}
    kinds = [*stage_fault_kinds(), "gain", "payload", "dwell", "wild"]
    faults: dict[int, list[Spoil]] = {}
    other: dict[str, range] = {}
    first = 1000
    for kind in (str(kind) for kind in rng.permutation(kinds)):
        samples = int(rng.integers(8, 16)) * MESSAGE
        if kind in ("gain", "payload"):
            path, value = {"gain": ("gain_drift.gain", -0.04), "payload": ("resonance.payload_ratio", 1.0)}[kind]
            faults[first] = [Spoil(parameter=path, value=value)]
        elif kind in ("dwell", "wild"):
            other[kind] = range(first, first + samples)
        else:
            faults[first] = [Spoil(kind, samples, values.get(kind, 0.0))]
        first += samples + 500
    n = first + 1500
    u_V = multitone(n * DT_S, DT_S, seed=21)[1][:n]
    u_V[:500] *= np.linspace(0.0, 1.0, 500)
    rest = other["dwell"]
    u_V[rest.start : rest.stop] = u_V[rest.start]
    # The last second comes from a stage that was started again: it counts and times from zero.
    last = n - 1000
    sent = [anew(wild(message, other["wild"], rng), last) for message in stage_messages(u_V, 21, faults, MESSAGE)]
    train_V = training_input(DT_S, 6.0)[1]
    return Tape("faulty", DT_S, train_V, stage_readings(train_V, 20), tuple(sent), (0.0, 10.0, 4000.0), {}, 400)


def wild(message: Batch, where: range, rng: np.random.Generator) -> Batch:
    """The message with wild numbers in some of its columns."""
    if int(message.seq[0]) not in where:
        return message
    t_s, u_V, y_um = message.t_s.copy(), message.u_V.copy(), message.y_um.copy()
    for values in (t_s, u_V, y_um):
        for number in (np.inf, -np.inf, np.nan, 1e300, -3e8, 5e-324):
            if rng.random() < 0.3:
                values[int(rng.integers(values.size))] = number
    return replace(message, t_s=t_s, u_V=u_V, y_um=y_um)


def for_replay(messages: Sequence[Batch]) -> Batch:
    """The samples as one recording, without voltages that no amplifier has: scoring fits a gain to all of them."""
    whole = joined(messages)
    return whole.where(~(np.isfinite(whole.u_V) & (np.abs(whole.u_V) > 1e6)))


def anew(message: Batch, first: int) -> Batch:
    """The message with numbers and times that count from ``first``, where it is not before."""
    if int(message.seq[0]) < first:
        return message
    seq = message.seq - first
    return replace(message, seq=seq, t_s=times(seq))


def measured_tape() -> Tape:
    """4000 samples of the measured stack, identified from its 1 Hz recording; skips where there are no data."""
    if not (data_folder() / "picma_stack" / "model_sine_1hz.csv").is_file():
        pytest.skip("measured data missing: picma_stack; set DEHYST_DATA to the folder that holds it")
    train, test = measured("model_sine_1hz.csv"), measured("test_ramped_sine_ff.csv")
    test = test.where(test.seq < 4000)
    dt_s = float(round(float(train.t_s[1] - train.t_s[0]), 9))
    low, high = float(min(train.u_V.min(), test.u_V.min())), float(max(train.u_V.max(), test.u_V.max()))
    limits = (low - 10.0, high + 10.0, 1e5)
    # As for the report on measured data: at 5 ms the window learns as often in time as at 1 ms.
    learner = {"learn_every": 2, "filter_every": 1, "admission": {"glitch_share": 0.1}}
    return Tape("measured", dt_s, train.u_V, train.y_um, tuple(split(test, MESSAGE)), limits, learner, 100, True)


# ---- one run


def trajectory(low: float, high: float, dt_s: float) -> tuple[Floats, Floats, Floats]:
    """(y_um, v_um_per_s, a_um_per_s2) of 200 fixed points: one and a half sine cycles, 10 % from both ends."""
    w = 2.0 * np.pi * 1.5 / (200 * dt_s)
    phase = w * dt_s * np.arange(200)
    middle, half = 0.5 * (low + high), 0.4 * (high - low)
    return middle + half * np.sin(phase), half * w * np.cos(phase), -half * w * w * np.sin(phase)


def answers(model: Model, y: Floats, v: Floats, a: Floats) -> dict[str, list[float]]:
    """A snapshot's answers at every tenth point from a stage at rest, and its memory after them."""
    said = model.feedforward(y, v, a, model.rest_memory(float(y[0])))
    return {"u_V": listed(said.u_V[::10]), "std_V": listed(said.std_V[::10]), "memory": listed(said.memory)}


def prints(axis: AnAxis, made: Tape) -> dict[str, str]:
    """Digests, to the last bit, of what all served models answer at the fixed points, and of their tracked memories."""
    newest = axis.newest
    found = {"seq": str(newest.seq)}
    points = trajectory(float(made.y_um.min()), float(made.y_um.max()), made.dt_s)
    for name, model in newest.models.items():
        said = model.feedforward(*points, newest.memories[name])
        for part in ("u_V", "std_V", "inside", "memory"):
            found[f"{name} {part}"] = digest(getattr(said, part).tobytes())
        found[f"{name} tracked"] = digest(newest.memories[name].tobytes())
    return found


def listed(values: Any) -> list[float]:
    """Numbers as plain floats."""
    return [float(value) for value in np.asarray(values, dtype=np.float64).ravel()]


def run(name: str, jitter: int = 0) -> Result:
    """Run one recording through an axis, with a checkpoint on the way and a replay of the same samples after it."""
    begin = time.perf_counter()
    made = tape(name, jitter)
    bundle = identified(made.u_V, made.y_um, made.dt_s, made.learner_scale)
    axis = new_axis(bundle, made.limits_V, made.learner)
    y, v, a = trajectory(float(made.y_um.min()), float(made.y_um.max()), made.dt_s)
    exact: dict[str, Any] = {}
    values: dict[str, list[float]] = {"readings_um": listed(joined(made.messages).y_um[::500])}
    for called, model in bundle.models.items():
        values[f"identified {called} u_V"] = answers(model, y, v, a)["u_V"]
    verdicts: Counter[str] = Counter()
    course: list[str] = []
    eighth = len(made.messages) // 8
    with tempfile.TemporaryDirectory() as folder:
        for k, message in enumerate(made.messages, 1):
            verdicts.update(axis.handle(message))
            if k % eighth == 0:
                newest = axis.newest
                course.append(f"{newest.seq} {standing(axis)['champion']} {newest.trouble or '-'}")
                values[f"course {k // eighth} u_V"] = answers(newest.models[CHAMPION], y, v, a)["u_V"][::4]
            if k == made.checkpoint_at:
                exact["checkpoint_while"] = f"{standing(axis)['champion']} {axis.newest.trouble or '-'}"
                write_checkpoint(axis, Path(folder))
        meta, state = checkpoint_entries(Path(folder), axis)
        other = new_axis(bundle, made.limits_V, made.learner)
        restored = read_checkpoint(other, Path(folder))
    for message in made.messages[made.checkpoint_at :]:
        other.handle(message)
    told = standing(axis)
    exact |= {
        "messages": len(made.messages),
        "course": course,
        "champion": told["champion"],
        "changes": told["changes"],
        "failed": {called: entry["failed"] for called, entry in told["contestants"].items()},
        "sequence": axis.sequence.counters(),
        "handled": axis.handled_seq,
        "snapshot": axis.newest.seq,
        "trouble": axis.newest.trouble,
        "stand_in": axis.newest.stand_in,
        "checkpoint": meta,
        "checkpoint_entries": entries(state),
    }
    for called, entry in told["contestants"].items():
        for part in ("rms_V", "scored"):
            values[f"score {called} {part}"] = [float(entry[part])]
    values["trust"] = [axis.newest.trust]
    for called, model in axis.newest.models.items():
        for part, numbers in answers(model, y, v, a).items():
            values[f"final {called} {part}"] = numbers
        values[f"final {called} tracked"] = listed(axis.newest.memories[called])
    counts = {
        "verdicts": dict(verdicts),
        "learner": learner_counters(axis),
        "events": dict(Counter(str(event["event"]) for event in axis.take_events())),
    }
    exact["wire"], values["wire reply"] = wire(axis, made, (y, v, a))
    replayed = new_axis(bundle, made.limits_V, made.learner)
    values_of_replay, counts["replay"] = foretold(replayed, for_replay(made.messages))
    values |= {f"replay {key}": [value] for key, value in values_of_replay.items()}
    pinned = {"exact": exact, "counts": counts, "values": values}
    ends = {"live": prints(axis, made), "restored": prints(other, made), "replayed": prints(replayed, made)}
    return Result(pinned, ends, restored, time.perf_counter() - begin)


def entries(state: Mapping[str, Any]) -> dict[str, str]:
    """Names of a state with their types, a line for each group; numbered entries are told once, with their count."""
    named = Counter((re.sub(r"[0-9]+(?=\.|$)", "#", key), form(value)) for key, value in state.items())
    groups: dict[str, list[str]] = {}
    for (key, kind), count in sorted(named.items()):
        group, _, name = key.rpartition(".")
        groups.setdefault(group or "-", []).append(f"{name} {kind}" + (f" x {count}" if count > 1 else ""))
    return {group: ", ".join(names) for group, names in groups.items()}


def form(value: Any) -> str:
    """Type and number of dimensions of an entry; how long it is depends on what was learnt."""
    return f"{value.dtype.str} {value.ndim}" if isinstance(value, np.ndarray) else type(value).__name__


def wire(axis: Axis, made: Tape, motion: tuple[Floats, Floats, Floats]) -> tuple[dict[str, Any], list[float]]:
    """What of the encoded messages of a run holds no computed floats, and the voltages of the reply."""
    reply = axis.answer(FeedforwardQuery(*motion))
    data = encode_reply(reply)
    numbers = 8 * (2 * reply.u_V.size + reply.memory.size)
    batch = made.messages[0]
    sent = encode_samples(batch.seq, batch.t_s, batch.u_V, batch.y_um)
    model = model_payload(axis, CHAMPION)
    back = decode_reply(data)
    assert encode_reply(back) == data
    assert digest(encode_samples(*columns(decode_samples(sent)))) == digest(sent)
    message = decode_model(model)
    assert encode_model(message.name, message.model, message.snapshot_seq, message.memory, message.safety) == model
    known = sent if made.exact_volts else sent[: 8 + 16 * len(batch)]
    told = {
        "reply_bytes": len(data),
        "reply_head": data[:REPLY_HEAD_BYTES].hex(),
        "reply_tail": data[REPLY_HEAD_BYTES + numbers :].hex(),
        "samples_bytes": len(sent),
        "samples_known": digest(known),
        "model_bytes_beside_text": len(model) - int.from_bytes(model[16:20], "little"),
        "model_head": model[:16].hex(),
    }
    return told, listed(back.u_V[::10])


def columns(batch: Batch) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """The four columns of a batch, in their order on the wire."""
    return batch.seq, batch.t_s, batch.u_V, batch.y_um


def constant_payloads() -> dict[str, str]:
    """Payloads of every small message from constants, as hexadecimal bytes."""
    half, std = np.array([0.5, 1.5, -2.25]), np.array([0.25, np.nan, 0.125])
    reply = Answer(half, std, np.array([0, 5, 96], np.uint8), half[:2], 41, "auto")
    under_way = Pending(7, np.array([1.0, 2.0]), np.array([0.5, 0.75]))
    made = {
        "samples": encode_samples([3, 4], [0.003, 0.004], [1.25, np.nan], [np.inf, -7.5]),
        "command": encode_command(5, half),
        "reference": encode_reference(6, half),
        "query_point": encode_query(40.0, 0.0, 0.0),
        "query_memory": encode_query(half, half, half, half[:1], "mpi", 12, 3.5),
        "query_pending": encode_query(half, half, pending=under_way),
        "reply": encode_reply(reply),
        "reply_stand_in": encode_reply(reply._replace(behind=True, tracked_memory=True, fallback=True, stand_in="mpi")),
    }
    for name in ("reply", "reply_stand_in"):
        assert encode_reply(decode_reply(made[name])) == made[name]
    assert decode_query(made["query_memory"]).model == "mpi"
    return {name: data.hex() for name, data in made.items()}


# ---- comparing


def plain(pinned: Any, digits: int = 17) -> Any:
    """The same with numbers of so many digits; what is not finite becomes text, which JSON can hold."""
    if isinstance(pinned, Mapping):
        return {str(key): plain(value, digits) for key, value in pinned.items()}
    if isinstance(pinned, (list, tuple)):
        return [plain(value, digits) for value in pinned]
    if isinstance(pinned, float):
        return float(f"{pinned:.{digits}g}") if np.isfinite(pinned) else str(pinned)
    return pinned


def difference(stored: Sequence[Any], got: Sequence[Any]) -> float:
    """Largest difference of two lists, relative to the largest number stored; infinite where they do not match."""
    if len(stored) != len(got):
        return float("inf")
    pairs = [(a, b) for a, b in zip(stored, got, strict=True) if not (isinstance(a, str) and a == b)]
    if any(isinstance(x, str) for pair in pairs for x in pair):
        return float("inf")
    size = max((abs(float(a)) for a, _ in pairs), default=0.0)
    most = max((abs(float(a) - float(b)) for a, b in pairs), default=0.0)
    return most / size if size > 0.0 else most


def count_difference(stored: Mapping[str, int], got: Mapping[str, int]) -> int:
    """Largest difference of two tables of counts; a missing name counts as zero."""
    return max((abs(stored.get(name, 0) - got.get(name, 0)) for name in {*stored, *got}), default=0)


def changes(stored: Mapping[str, Any], got: Mapping[str, Any], slack: int) -> list[str]:
    """What of a run has changed, a line each."""
    found = []
    for key in sorted({*stored["exact"], *got["exact"]}):
        was, now = stored["exact"].get(key), got["exact"].get(key)
        if was != now:
            found.append(f"{key}: {brief(was, now)}")
    for key in sorted({*stored["counts"], *got["counts"]}):
        was, now = stored["counts"].get(key, {}), got["counts"].get(key, {})
        if count_difference(was, now) > slack:
            found.append(f"counts of {key}: {brief(was, now)}")
    for key in sorted({*stored["values"], *got["values"]}):
        was, now = stored["values"].get(key), got["values"].get(key)
        off = difference(was, now) if was is not None and now is not None else float("inf")
        if not off <= TOLERANCE:
            found.append(f"{key}: off by {off:.2g}, {TOLERANCE:.2g} allowed: {brief(was, now)}")
    return found


def brief(was: Any, now: Any) -> str:
    """Both sides, without what they share."""
    if isinstance(was, Mapping) and isinstance(now, Mapping):
        keys = [key for key in {**was, **now} if was.get(key) != now.get(key)]
        return ", ".join(f"{key} {was.get(key)} -> {now.get(key)}" for key in keys)
    if isinstance(was, list) and isinstance(now, list):
        if len(was) == len(now):
            pairs = [f"[{i}] {a} -> {b}" for i, (a, b) in enumerate(zip(was, now, strict=True)) if a != b]
            return ", ".join(pairs[:4]) + (f" and {len(pairs) - 4} more" if len(pairs) > 4 else "")
        gone, new = [x for x in was if x not in now], [x for x in now if x not in was]
        return f"{len(was)} -> {len(now)} entries; gone: {gone[:6]}; new: {new[:6]}"
    return f"{was} -> {now}"


@cache
def result(name: str) -> Result:
    """One run of a recording for all tests."""
    return run(name)


@cache
def golden() -> dict[str, Any]:
    """The stored file."""
    stored: dict[str, Any] = json.loads(GOLDEN.read_text(encoding="utf-8"))
    return stored


# ---- tests


@pytest.mark.parametrize("name", NAMES)
def test_results_are_those_stored(name: str) -> None:
    """Exact where no computed float is in it, counts and values within what was measured (see the module)."""
    found = changes(golden()[name], plain(result(name).pinned), COUNT_SLACK)
    assert not found, f"{len(found)} changes in {name!r}:\n  " + "\n  ".join(found)


@pytest.mark.parametrize("name", NAMES)
def test_an_axis_from_a_checkpoint_goes_on_to_the_last_bit(name: str) -> None:
    """The checkpoint is written half way; both axes then get the second half."""
    done = result(name)
    assert done.restored
    assert done.ends["restored"] == done.ends["live"]


@pytest.mark.parametrize("name", NAMES)
def test_the_same_samples_in_other_messages_give_the_same_models_to_the_last_bit(name: str) -> None:
    """A second axis gets the samples in messages of another size."""
    assert fed_again(tape(name), joined(tape(name).messages)) == result(name).ends["live"]


@pytest.mark.parametrize("name", NAMES)
def test_a_replay_gives_the_same_models_to_the_last_bit(name: str) -> None:
    """The command's replay against the live axis; with wild voltages, against an axis that did not get them either."""
    made, ends = tape(name), result(name).ends
    samples = for_replay(made.messages)
    whole = len(samples) == len(joined(made.messages))
    assert whole == (name != "faulty")
    assert ends["replayed"] == (ends["live"] if whole else fed_again(made, samples))


def fed_again(made: Tape, samples: Batch) -> dict[str, str]:
    """Digests of the models of a fresh axis after ``samples``, given in messages of 137."""
    axis = new_axis(identified(made.u_V, made.y_um, made.dt_s, made.learner_scale), made.limits_V, made.learner)
    for message in split(samples, 137):
        axis.handle(message)
    return prints(axis, made)


def test_payloads_of_constants_are_the_same_bytes() -> None:
    """The wire format itself, without any model."""
    assert constant_payloads() == golden()["payloads"]


# ---- renewing the file, measuring the tolerance


def text_of(value: Any, depth: int = 0) -> str:
    """JSON with a line for each entry of a table and for each list, so that a change is a line of the diff."""
    if not isinstance(value, Mapping):
        return json.dumps(value, ensure_ascii=False)
    inner = " " * (depth + 1)
    lines = [f"{inner}{json.dumps(key)}: {text_of(entry, depth + 1)}" for key, entry in value.items()]
    return "{\n" + ",\n".join(lines) + "\n" + " " * depth + "}" if lines else "{}"


def write() -> int:
    """Run everything, print what has changed, write the file. Returns the number of changes."""
    stored = golden() if GOLDEN.exists() else {}
    made: dict[str, Any] = {"payloads": constant_payloads()}
    found = [] if made["payloads"] == stored.get("payloads") else [brief(stored.get("payloads", {}), made["payloads"])]
    print_changes("payloads", found)
    changed = len(found)
    for name in NAMES:
        try:
            done = result(name)
        except pytest.skip.Exception as missing:
            print(f"{name}: kept as it is: {missing}")
            made |= {name: stored[name]} if name in stored else {}
            continue
        made[name] = plain(done.pinned, DIGITS)
        new = name not in stored
        found = ["new"] if new else changes(stored[name], plain(done.pinned), COUNT_SLACK)
        print_changes(f"{name} ({done.seconds:.1f} s)", found)
        changed += len(found)
    GOLDEN.write_text(text_of(made) + "\n", encoding="utf-8")
    print(f"{changed} changes beyond the tolerance; {GOLDEN.name} written")
    return changed


def print_changes(name: str, found: Sequence[str]) -> None:
    """The changes of one recording, a line each."""
    print(f"{name}: {len(found)} changes")
    for line in found:
        print(f"  {line}")


def sensitivity(runs: int) -> None:
    """Print how far perturbed readings move the results: the worst of ``runs`` runs for each recording."""
    for name in NAMES:
        stored = plain(result(name).pinned)
        worst: dict[str, float] = {}
        counts: dict[str, int] = {}
        for seed in range(1, runs + 1):
            moved = plain(run(name, seed).pinned)
            for key, numbers in stored["values"].items():
                off = difference(numbers, moved["values"][key])
                worst[key] = max(off, worst.get(key, 0.0))
            for key, table in stored["counts"].items():
                off_by = count_difference(table, moved["counts"][key])
                counts[key] = max(off_by, counts.get(key, 0))
                if off_by:
                    print(f"{name}, seed {seed}: counts of {key}: {brief(table, moved['counts'][key])}")
            # The payload of a measured batch holds the readings, which are perturbed.
            moved["exact"]["wire"]["samples_known"] = stored["exact"]["wire"]["samples_known"]
            for key, entry in stored["exact"].items():
                if entry != moved["exact"][key]:
                    print(f"{name}: {key} changed: {brief(entry, moved['exact'][key])}")
        print(f"{name}: counts {counts}")
        for key, off in sorted(worst.items(), key=lambda pair: -pair[1])[:12]:
            print(f"  {off:.2e}  {key}")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.golden.test_golden", description="Renew golden.json, or measure what it is sensitive to."
    )
    parser.add_argument("--write", action="store_true", help="run all recordings, print what changed, write the file")
    parser.add_argument("--sensitivity", type=int, metavar="RUNS", help="perturb readings, print how far results move")
    options = parser.parse_args(arguments)
    if options.sensitivity:
        sensitivity(options.sensitivity)
    if options.write:
        write()
    if not (options.write or options.sensitivity):
        parser.print_help()
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
