"""Records of other authors: the learner and the served axis beside frozen model, baselines and simple regressions.

``python -m benchmarks.measured`` identifies each record of ``RECORDS`` on its first part and replays the rest. Every
method predicts the voltage from the measured displacement at the same instants. The score is the RMSE in percent of the
training span of the voltage, without the first tenth of the test.

learner : `Learner.snapshot`, ``AGE_S`` old, over the smoothed motion, from the memory that the learner had then and
    that the model's own operators carry on. served : what an axis with the default competition answers to a query as of
    that time, with its fallbacks. Both begin with the test. frozen, linear, bouc_wen, mpi : as identified.
recursive : 40 plays and other columns by recursive least squares, with forgetting, its coefficients ``AGE_S`` old;
    ``yardstick`` is the best of its three. least squares : the same columns, fitted once.
worst : largest ratio of the RMSE of served over that of frozen within two seconds; frozen counts at least 0.1 %.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import savgol_filter

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.learner import Learner
from dehyst.adaptive.smoothing import smooth_recording
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray, InverseModel, Sample
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.guard import Limits
from dehyst.service.config.learner import learner_config
from dehyst.service.config.settings import COMPETE, LEARN, AxisConfig
from dehyst.service.identification.identifying import Stretch, free_run, identify_one
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.reports import tables
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from dehyst.sim.recordings import ColumnMap, Recording, read

# --- The records.


@dataclass(frozen=True, slots=True)
class Source:
    """A file, and what its columns mean."""

    path: str
    mapping: ColumnMap = field(default_factory=ColumnMap)

    def read(self, folder: Path) -> Recording:
        """The recording. Raises FileNotFoundError where the file is missing."""
        path = folder / self.path
        if not path.exists():
            raise FileNotFoundError(2, "missing", str(path))
        return read(path, self.mapping)


@dataclass(frozen=True, slots=True)
class Record:
    """Where to identify and where to test, s from the begin of each file.

    test : another file of the same stage, which begins at its own rest; None: the test goes on where training ended.
    """

    name: str
    train: Source
    train_s: tuple[float, float]
    test_s: tuple[float, float]
    test: Source | None = None


def multisine(file: str, channel: int, realisation: int) -> Source:
    """One channel and realisation, whose periods follow each other."""
    index = dict.fromkeys(("u", "y"), f":,{channel},{realisation},*")
    mapping = ColumnMap(columns={"u": "u", "rate": "fs_hz"}, units={"u": "V", "rate": "Hz"}, index=index)
    return Source(f"fine_steering_mirror/fsm_{file}.npz", mapping)


def _mirror(level: int, channel: int) -> Record:
    # There is no test file of the largest amplitude.
    other, realisation = ("train", 1) if level == 300 else ("test", 0)
    train, test = multisine(f"{level}mV_train", channel, 0), multisine(f"{level}mV_{other}", channel, realisation)
    return Record(f"mirror {level} mV, {channel}", train, (0.0, math.inf), (0.0, math.inf), test)


def _benchmark(file: str) -> Source:
    columns = {"u": "u_N", "y": "y_m", "rate": "fs_hz"}
    return Source(f"boucwen_benchmark/{file}.npz", ColumnMap(columns=columns, scale={"u": 1.0, "rate": 1.0}))


_STACK = [Source(f"picma_stack/{name}.csv") for name in ("model_sine_1hz", "test_ramped_sine_ff")]
_MEASURED = {name: Source(f"measured/{name}.parquet") for name in
             ("friction-damper-1Hz", "friction-damper-2Hz", "friction-damper-earthquake", "silverbox")}  # fmt: skip
_SWEEP = Source("rasters/a0-identification.parquet")
#: Tests of long records are cut so that each takes about half a minute. The mirror's axes are driven together, and each
#: displacement answers to all three drives: its rows say how a method fails there. From the measured folder u and y
#: are no voltage and displacement; the numbers are of the same kind.
RECORDS: tuple[Record, ...] = (
    Record("stack, 1 Hz", _STACK[0], (0.5, 15.0), (15.0, 41.0)),
    Record("stack, ramped", _STACK[1], (0.5, 30.0), (30.0, 71.0)),
    *(_mirror(level, channel) for level in (100, 200, 300) for channel in range(3)),
    Record("Bouc-Wen, train", _benchmark("train_multisine_5periods_noisy"), (0.0, 22.0), (22.0, 44.0)),
    Record("Bouc-Wen, est", _benchmark("est_multisine_4periods_noisy"), (0.0, 22.0), (22.0, 44.0)),
    Record("Bouc-Wen, test", _benchmark("train_multisine_5periods_noisy"), (0.0, 22.0), (0.0, 11.0),
           _benchmark("test_multisine")),
    Record("friction damper, 1 Hz", _MEASURED["friction-damper-1Hz"], (0.0, 3.5), (3.5, 7.0)),
    Record("friction damper, 2 Hz", _MEASURED["friction-damper-2Hz"], (0.0, 1.75), (1.75, 3.5)),
    Record("friction damper, quake", _MEASURED["friction-damper-earthquake"], (0.0, 10.0), (10.0, 24.0)),
    Record("silverbox", _MEASURED["silverbox"], (0.0, 33.0), (33.0, 60.0)),
    *(Record(f"raster, {hz} Hz", _SWEEP, (0.0, 10.0), (0.0, 9.0), Source(f"rasters/a0-triangle-{hz}Hz.parquet"))
      for hz in (1, 5, 15)),
    *(Record(f"foreign, {name}", Source(f"foreign-stages/{name}-identification.parquet"), (0.0, 10.0), (0.0, 11.0),
             Source(f"foreign-stages/{name}-run.parquet"))
      for name in ("gain-down", "gain-up-a", "gain-up-b", "knock")),
    *(Record(f"case {number}", Source(f"foreign-cases/case-{number}.parquet"), (0.0, 33.0), (33.0, 44.0))
      for number in ("06", "10", "11", "16", "17", "23", "25", "26", "27", "28")),
)  # fmt: skip


def data_folder() -> Path:
    """The folder of records: that of ``DEHYST_DATA``, by default ``shared/data`` beside the project."""
    return Path(os.environ.get("DEHYST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@dataclass(frozen=True, slots=True)
class Cut:
    """(n,) voltages V and displacements µm, ``dt_s`` apart, of which the first ``split`` are for training.

    jump : whether the two parts are of different runs. left : samples of the file after the test.
    """

    dt_s: float
    u_V: FloatArray
    y_um: FloatArray
    split: int
    jump: bool
    left: int = 0

    @classmethod
    def of(cls, record: Record, folder: Path, late: int = 0) -> Cut:
        """Read and cut a record whose readings are ``late`` samples late. Raises OSError where a file is missing."""
        parts = []
        for source, (begin_s, end_s) in ((record.train, record.train_s), (record.test or record.train, record.test_s)):
            recording = source.read(folder)
            dt_s, n = recording.dt_s, len(recording) - late
            begin, end = (round(min(at_s / dt_s, n)) for at_s in (begin_s, end_s))
            parts.append((recording.u_V[begin:end], recording.y_um[late + begin : late + end]))
        u_V, y_um = (np.concatenate(column) for column in zip(*parts, strict=True))
        return cls(dt_s, u_V, y_um, parts[0][0].size, record.test is not None, n - end)

    @property
    def pieces(self) -> list[slice]:
        """The stretches without a jump of the time."""
        n = self.u_V.size
        return [slice(0, self.split), slice(self.split, n)] if self.jump else [slice(0, n)]

    @property
    def whole(self) -> Stretch:
        """Both parts with their smoothed motion."""
        smoother = LearnerConfig().smoother(self.dt_s)
        motion = np.concatenate([smooth_recording(self.y_um[piece], smoother) for piece in self.pieces])
        return Stretch(self.u_V, self.y_um, motion, np.ones(self.u_V.size, dtype=np.bool_))

    @property
    def limits(self) -> Limits:
        """Limits that the record does not reach."""
        ends = [(x.min() - MARGIN * np.ptp(x), x.max() + MARGIN * np.ptp(x)) for x in (self.u_V, self.y_um)]
        (u_low, u_high), (y_low, y_high) = ((float(low), float(high)) for low, high in ends)
        return Limits(u_low, u_high, math.inf, y_low, y_high)


# --- The yardstick: columns from the displacement, and least squares, once and recursively.

#: Age of a model or of coefficients when they are used, s.
AGE_S = 0.06
#: Times within which the recursive least squares forget, s.
FORGET_S = (2.0, 10.0, 60.0)
PLAYS = 40


def plays(y: FloatArray, radii: FloatArray) -> FloatArray:
    """(n, m) play operators of (n,) values, with (m,) radii; all begin at rest."""
    out, w = np.empty((y.size, radii.size)), np.full(radii.size, y[0])
    for k, x in enumerate(y):
        w = np.minimum(np.maximum(w, x - radii), x + radii)
        out[k] = w
    return out


def columns_of(cut: Cut) -> tuple[FloatArray, IntArray]:
    """(m, p) columns, scaled by their training part, and the (m,) samples that they are of, 1 ms or more apart."""
    dt_s, thin = cut.dt_s, max(1, math.ceil(0.001 / cut.dt_s - 1e-9))
    width = min(max(5, int(0.01 / dt_s) // 2 * 2 + 1) if dt_s < 0.002 else 5, 21)
    smooth = [savgol_filter(cut.y_um[piece], width, 2) for piece in cut.pieces]
    at = np.concatenate([np.arange(piece.start, piece.stop, thin) for piece in cut.pieces])
    train = at < cut.split
    v = [np.gradient(y, dt_s)[::thin] for y in smooth]
    a = np.concatenate([np.gradient(part, dt_s * thin) for part in v])
    known = np.concatenate([y[::thin] for y in smooth])
    low, high = known[train].min(), known[train].max()
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    radii = np.linspace(0.0, 1.0, PLAYS + 1)[1:]
    parts = [(y[::thin] - middle) / half for y in smooth]
    q, w, speed = np.concatenate(parts), np.concatenate([plays(part, radii) for part in parts]), np.concatenate(v)
    scaled = [part / part[train].std() for part in (speed, a)]
    X = np.column_stack([np.ones(q.size), q, q**2, q**3, w, w[:, ::4] * q[:, None], *scaled])
    mean, scale = X[train].mean(axis=0), X[train].std(axis=0)
    mean[0], scale[0] = 0.0, 1.0
    return (X - mean) / np.where(scale > 0.0, scale, 1.0), at


def least_squares(Z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(p,) coefficients of (n, p) columns for (n,) targets, slightly regularised, and (p, p) inverse information."""
    P: FloatArray = np.linalg.inv(Z.T @ Z + 1e-6 * u.size * np.eye(Z.shape[1])).astype(np.float64)
    return P @ (Z.T @ u), P


def recursive(Z: FloatArray, u: FloatArray, c: FloatArray, P: FloatArray, forget: float, age: int) -> FloatArray:
    """(n,) predictions by coefficients that have not seen the sample and the ``age`` before it.

    c (p,), P (p, p) : see `least_squares`. forget : weight of a sample once the next has come.
    """
    start, out = P, np.empty(u.size)
    past = deque([c] * (age + 1), maxlen=age + 1)
    for k in range(u.size):
        out[k] = Z[k] @ past[0]
        Pz = P @ Z[k]
        gain = Pz / (forget + Z[k] @ Pz)
        c = c + gain * (u[k] - Z[k] @ c)
        P = (P - np.outer(gain, Pz)) / forget
        if np.trace(P) > 1e6 * c.size:
            P = start
        past.append(c)
    return out


def regressions(cut: Cut) -> tuple[dict[str, FloatArray], IntArray]:
    """Predictions of the regressions, V, at samples of the test (counted from its begin)."""
    Z, at = columns_of(cut)
    n = int(np.searchsorted(at, cut.split))
    u, dt_s = cut.u_V[at], cut.dt_s * float(at[1] - at[0])
    c, P = least_squares(Z[:n], u[:n])
    found = {"least squares": Z[n:] @ c}
    for forget_s in FORGET_S:
        age = max(1, round(AGE_S / dt_s))
        found[f"recursive, {forget_s:g} s"] = recursive(Z[n:], u[n:], c, P, math.exp(-dt_s / forget_s), age)
    return found, at[n:] - cut.split


# --- The learner and the axis over the test.

#: Time between two snapshots, s.
BLOCK_S = 0.004


def replayed(
    test: Stretch,
    dt_s: float,
    teach: Callable[[slice], None],
    newest: Callable[[], tuple[int, InverseModel, FloatArray] | None],
    answer: Callable[[int, InverseModel, FloatArray, tuple[FloatArray, FloatArray, FloatArray]], FloatArray],
) -> FloatArray:
    """(n,) voltages predicted by what was served ``AGE_S`` before the begin of each block; NaN before there is one.

    teach : lets the samples of a block be learnt. newest : what is then served: the last sample that it knows, the
    model, and its memory after that sample. answer : the same with the memory carried on to the points before which it
    is, and these (y, v, a); returns voltages.
    """
    block, age, n = max(1, round(BLOCK_S / dt_s)), max(1, round(AGE_S / dt_s)), len(test)
    y, v, a = (np.ascontiguousarray(column) for column in test.motion.T)
    out, past = np.full(n, np.nan), deque[tuple[int, int, InverseModel, FloatArray]]()
    for first in range(0, n, block):
        part = slice(first, min(n, first + block))
        while len(past) > 1 and past[1][0] < first - age:
            past.popleft()
        if past and past[0][0] < first - age:
            _, seen, model, memory = past[0]
            way = slice(seen + 1, first)
            memory = model.track(y[way], v[way], a[way], test.u_V[way], memory)
            out[part] = answer(seen, model, memory, (y[part], v[part], a[part]))
        teach(part)
        now = newest()
        if now is not None:
            past.append((part.stop - 1, *now))
    return out


def learnt(
    model: LssvmInverse, test: Stretch, dt_s: float, limits: Limits, settings: dict[str, Any] | None = None
) -> tuple[FloatArray, list[str]]:
    """(n,) voltages of the snapshots of a learner with these settings, V, and its verdicts on the samples."""
    learner = Learner.from_model(model, learner_config(settings or {}, limits, "learner"))
    verdicts: list[str] = []

    def teach(part: slice) -> None:
        for k in range(part.start, part.stop):
            verdicts.append(learner.handle(Sample(k, k * dt_s, float(test.u_V[k]), float(test.y_um[k]))))

    def newest() -> tuple[int, InverseModel, FloatArray] | None:
        snapshot = learner.snapshot()
        memory = learner.memory_for(snapshot)
        return None if memory is None else (learner.seq, snapshot, memory)

    got = replayed(test, dt_s, teach, newest, lambda _seq, at, memory, points: at.feedforward(*points, memory).u_V)
    return got, verdicts


@dataclass(frozen=True, slots=True)
class Served:
    """u_V (n,) : answers. verdicts : samples by verdict. troubles : (time s, what the axis said).

    champions : blocks by the model that answered.
    """

    u_V: FloatArray
    verdicts: Counter[str]
    troubles: list[tuple[float, str]]
    champions: Counter[str]


def served(models: dict[str, InverseModel], test: Stretch, dt_s: float, limits: Limits, meta: BundleMeta) -> Served:
    """What an axis would have answered at the motion of the test."""
    block = max(1, round(BLOCK_S / dt_s))
    config = AxisConfig(
        "x", Path("measured"), limits, compete=tuple(name for name in COMPETE if name in models), snapshot_every=block
    )
    axis = load_axis("measured", config, bundle=Bundle(models, meta))
    found = Served(np.empty(0), Counter(), [], Counter())

    def teach(part: slice) -> None:
        # Numbers from 1 on: a snapshot then falls on the last sample of a block.
        k = np.arange(part.start, part.stop)
        found.verdicts.update(axis.handle(SampleBatch(k + 1, k * dt_s, test.u_V[part], test.y_um[part])))
        said = ("trouble", "recovered", "learner_failed", "internal_error")
        events = (event for event in axis.take_events() if event["event"] in said)
        found.troubles.extend((part.stop * dt_s, f"{event['event']}: {event['detail']}") for event in events)

    def newest() -> tuple[int, InverseModel, FloatArray] | None:
        model, seq, memory = axis.model(axis.served)
        found.champions[model.names[model.champion] if isinstance(model, ChampionInverse) else axis.served] += 1
        return None if seq < 1 else (seq - 1, model, memory)

    def answer(
        seq: int, _: InverseModel, memory: FloatArray, points: tuple[FloatArray, FloatArray, FloatArray]
    ) -> FloatArray:
        return axis.answer(FeedforwardQuery(*points, memory, as_of=seq + 1)).u_V

    return Served(replayed(test, dt_s, teach, newest, answer), found.verdicts, found.troubles, found.champions)


# --- Scores.

#: Share of the test that is not scored. Length of the stretches of ``worst``, s, and least error of frozen there, %.
SKIPPED, WORST_S, LEAST_PCT = 0.1, 2.0, 0.1
#: Share of the range beyond the record's own at which the axis has its limits, so that none is reached.
MARGIN = 0.25


def rmse_pct(predicted_V: FloatArray, u_V: FloatArray, span_V: float) -> float:
    """Root mean square of (n,) errors in percent of a span, V."""
    return 100.0 / span_V * float(np.sqrt(np.mean((predicted_V - u_V) ** 2)))


def worst_ratio(one_pct: FloatArray, other_pct: FloatArray, window: int) -> float:
    """Largest ratio of the RMS of (n,) errors, %, over that of others (at least ``LEAST_PCT``) in ``window`` values."""
    window = min(window, one_pct.size)
    sums = [np.cumsum(np.r_[0.0, error**2]) for error in (one_pct, other_pct)]
    one, other = (np.sqrt(np.maximum(s[window:] - s[:-window], 0.0) / window) for s in sums)
    return float(np.max(one / np.maximum(other, LEAST_PCT)))


def ratio(scores: dict[str, float], name: str) -> float:
    """RMSE of ``name`` over that of the best of frozen, baselines and yardstick."""
    return scores[name] / min(scores[other] for other in ("frozen", *COMPETE, "yardstick") if other in scores)


def measure(name: str, cut: Cut) -> dict[str, Any]:
    """All numbers of a record, JSON form. Raises InputError where its first part identifies no model."""
    begun, n, dt_s = time.monotonic(), cut.split, cut.dt_s
    whole = cut.whole
    train, test = whole.part(0, n), whole.part(n, len(whole))
    models: dict[str, InverseModel] = {}
    failed = {}
    for model in (LEARN, *COMPETE):
        try:
            models[model] = identify_one(model, train.u_V, train.y_um, dt_s, 500)
        except (DehystError, np.linalg.LinAlgError) as error:
            if model == LEARN:
                raise
            failed[model] = str(error)
    identified = models[LEARN]
    assert isinstance(identified, LssvmInverse)
    before = None if cut.jump else train
    predicted = {("frozen" if m == LEARN else m): free_run(model, before, test) for m, model in models.items()}
    limits = cut.limits
    features = identified.features
    meta = BundleMeta("measured", "x", dt_s, y_min_um=features.y_min_um, y_max_um=features.y_max_um,
                      u_min_V=float(train.u_V.min()), u_max_V=float(train.u_V.max()))  # fmt: skip
    axis = served(models, test, dt_s, limits, meta)
    predicted |= {"learner": learnt(identified, test, dt_s, limits)[0], "served": axis.u_V}
    simple, at = regressions(cut)
    scored: BoolArray = np.isfinite(axis.u_V[at]) & np.isfinite(predicted["learner"][at])
    scored &= at >= SKIPPED * len(test)
    at, span_V = at[scored], float(np.ptp(train.u_V))
    values = {key: u[at] for key, u in predicted.items()} | {key: u[scored] for key, u in simple.items()}
    scores = {key: rmse_pct(u, test.u_V[at], span_V) for key, u in values.items()}
    scores["yardstick"] = min(score for key, score in scores.items() if key.startswith("recursive"))
    errors = [100.0 / span_V * (values[key] - test.u_V[at]) for key in ("served", "frozen")]
    return {
        "record": name,
        "samples": [n, len(test), cut.left],
        "dt_s": dt_s,
        "scores": scores,
        "learner_ratio": ratio(scores, "learner"),
        "served_ratio": ratio(scores, "served"),
        "worst": worst_ratio(errors[0], errors[1], round(WORST_S / (dt_s * float(at[1] - at[0])))),
        "verdicts": {verdict: count / len(test) for verdict, count in axis.verdicts.most_common()},
        "champions": {key: count / axis.champions.total() for key, count in axis.champions.most_common()},
        "troubles": axis.troubles,
        "failed": failed,
        "seconds": time.monotonic() - begun,
    }


# --- The table.

SCORES = ("frozen", *COMPETE, "least squares", *(f"recursive, {s:g} s" for s in FORGET_S), "learner", "served")
HEAD = (
    "record",
    "training / test, s",
    *SCORES,
    "learner / best",
    "served / best",
    "worst 2 s",
    "verdicts, %",
    "answered, %",
    "troubles",
)


def row(result: dict[str, Any]) -> tuple[str, ...]:
    """The cells of a record."""
    scores = [f"{result['scores'][name]:.3f}" if name in result["scores"] else "-" for name in SCORES]
    ratios = [f"{result[name]:.2f}" for name in ("learner_ratio", "served_ratio", "worst")]
    shares = [
        ", ".join(f"{name} {100 * share:.0f}" for name, share in result[key].items() if share >= 0.005)
        for key in ("verdicts", "champions")
    ]
    begun = [(t_s, said.split()[1].rstrip(":")) for t_s, said in result["troubles"] if said.startswith("trouble")]
    told = [f"{name} ({', '.join(f'{t_s:.2f} s' for t_s, other in begun if other == name)})"
            for name in dict.fromkeys(name for _, name in begun)]  # fmt: skip
    train_s, test_s, left_s = (n * result["dt_s"] for n in result["samples"])
    lengths = f"{train_s:.3g} / {test_s:.3g}" + (f" of {test_s + left_s:.3g}" if left_s > 0.1 * test_s else "")
    return (result["record"], lengths, *scores, *ratios, *shares, "; ".join(told) or "-")


def summary(results: Sequence[dict[str, Any]]) -> str:
    """How many records each of learner and served wins, and the worst of them."""
    lines = []
    for name in ("learner", "served"):
        ratios = {result["record"]: result[f"{name}_ratio"] for result in results}
        worst = max(ratios, key=lambda record: ratios[record])
        within = [sum(value <= most for value in ratios.values()) for most in (1.0, 1.2)]
        lines.append(
            f"{name} over the best of frozen, baselines and yardstick: at most 1.0 in {within[0]}, at most 1.2 in "
            f"{within[1]} of {len(ratios)} records; worst {ratios[worst]:.2f}, {worst}"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all records, or those that are named; prints a line each, then the table. 1 where none was found."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.measured", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", default=[""], metavar="NAME", help="records with one of these in the name")
    parser.add_argument("--late", type=int, default=0, metavar="N", help="samples by which the readings are late")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    given = parser.parse_args(arguments)
    if given.late < 0:
        parser.error(f"--late: got {given.late}, expected 0 or more samples")
    results = []
    for record in RECORDS:
        if not any(name in record.name for name in given.only):
            continue
        try:
            results.append(measure(record.name, Cut.of(record, data_folder(), given.late)))
        except OSError as error:
            print(f"{record.name}: skipped: {error.filename or error}: missing; set DEHYST_DATA to its folder")
        except DehystError as error:
            print(f"{record.name}: skipped: {error}")
        else:
            print(json.dumps(tables.json_form(results[-1])), flush=True)
        if given.json:
            given.json.write_text(json.dumps(tables.json_form(results), indent=1) + "\n")
    if not results:
        return 1
    print(f"\nRMSE in % of the training span of u\n\n{tables.markdown(HEAD, [row(result) for result in results])}\n")
    print(summary(results))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
