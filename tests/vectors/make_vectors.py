"""Make the test vectors of the protocol: payloads as they go over the wire, and the answers of the service to them.

``python -m tests.vectors.make_vectors [--out docs/protocol/vectors]``. Everything comes from one seed. Parameters of
models, and motions, are plain arithmetic and the same bytes on every machine; the last bits of memories and answers
depend on the processor. docs/protocol.md ("Test vectors") describes the files.
"""

from __future__ import annotations

import argparse
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from dehyst.adaptive.features import FeatureMap
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray, InverseModel, MovingPart
from dehyst.baselines.bouc_wen.model import BoucWenInverse, BoucWenParameters
from dehyst.baselines.common import Domain
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.baselines.linear import LinearInverse, LinearParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.service.answers.answering import Served, answer, blends, learns
from dehyst.service.answers.correcting import Correcting
from dehyst.service.answers.guard import Limits, limit_voltage
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.settings import AxisConfig
from dehyst.service.fleet.wire import FLEET_CHANGES, FLEET_QUERY, FLEET_REPLY, FLEET_SAMPLES, encode_fleet
from dehyst.service.protocol.delta import checksum, encode_delta
from dehyst.service.protocol.keys import AUTO, Keys
from dehyst.service.protocol.model import Safety, encode_model
from dehyst.service.protocol.query import Pending, Trajectory, decode_query, encode_query, encode_reply
from dehyst.service.protocol.samples import (
    COMMAND,
    DELTA,
    FEEDFORWARD_QUERY,
    MODEL,
    SAMPLES,
    encode_command,
    encode_reference,
    encode_samples,
)
from dehyst.service.security.authenticator import Authenticator

SEED: Final = 20
DT_S: Final = 1e-3
#: Range that the models have learnt, µm, and the limits of the axis, which go beyond it.
Y_UM: Final = (0.0, 90.0)
LIMITS: Final = Limits(0.0, 10.0, 2000.0, -40.0, 140.0)
DOMAIN: Final = Domain(*Y_UM, 2e4)
#: Frame of a stage whose gain has dropped by 6 % and whose zero has moved.
JUMPED: Final = {"gain": 0.94, "offset_um": 1.8}
LEARNING: Final = "lssvm_adaptive"
DEFAULT_OUT: Final = Path(__file__).resolve().parents[2] / "docs" / "protocol" / "vectors"
COLUMNS: Final = "case model query reply continues u_min_V u_max_V slew_V_per_s y_min_um y_max_um age_s"


# --- Models: not identified, but of the form, size and voltages of identified ones.


def lssvm(rng: np.random.Generator, features: FeatureMap, n: int, bounded: bool, name: str = LEARNING) -> LssvmInverse:
    """An LSSVM of ``n`` samples for a stage of 11 µm/V; ``bounded``: with an anchor and a covariance."""
    p, d = features.basis_size, features.kernel_size
    beta = rng.uniform(-0.02, 0.02, p)
    beta[0] = 4.1
    if features.linear:
        beta[1] = 4.0
        plays = slice(6, 6 + len(features.thresholds_um))
        beta[plays] = 0.3 / max(1, len(features.thresholds_um))
    root = rng.uniform(-1e-3, 1e-3, (p, p))
    anchor = beta.copy()
    if features.linear:
        anchor[1] *= 0.93  # the bound is active at both ends of the range, and not in its middle
    return LssvmInverse(
        name, features, beta, rng.uniform(-1.2, 1.2, (n, d)), rng.uniform(-0.4, 0.4, n),
        rng.uniform(0.3, 2.0, d), 250.0,
        domain=np.array([*Y_UM, -2e4, 2e4, -1e7, 1e7]), noise_variance=4e-6, kernel_variance=9e-4,
        beta_covariance=np.sum(root[:, :, None] * root.T[None], axis=1) if bounded else np.empty((0, 0)),
        span_V=10.0, seq=4000, anchor=anchor if bounded else np.empty(0), allowed_V=0.25 if bounded else 0.0,
    )  # fmt: skip


def feature_map(
    plays: int, arcs: tuple[float, ...], slow: tuple[float, ...], kernel_plays: tuple[int, ...]
) -> FeatureMap:
    """A map with ``plays`` evenly spaced thresholds."""
    return FeatureMap(
        DT_S, *Y_UM, 9e3, 4e6, tuple(1.5 * (i + 1) for i in range(plays)), arcs, slow, kernel_plays,
        asymmetric=plays > 0, linear=plays > 0, y_rest_um=3.0, dead_um=0.02,
    )  # fmt: skip


BOUC_WEN: Final = BoucWenInverse(
    BoucWenParameters(0.2789, 8.9055e5, 3.5244e8, 11.0, 0.31, 0.42, 0.18, 1.2), DT_S, DOMAIN, 0.11
)
MPI: Final = MpiInverse(
    MpiParameters((0.0, 0.4, 1.1, 2.3), (7.5, 1.6, 1.1, 0.8), (0.0, 20.0, 55.0), (1.0, 0.07, -0.12), 0.4, 0.9, 0.0007),
    DT_S, DOMAIN, 0.06,
)  # fmt: skip
LINE: Final = LinearInverse(LinearParameters(11.0, 1.0), DT_S, DOMAIN, 0.05)


def in_frame(model: LssvmInverse, frame: dict[str, float]) -> LssvmInverse:
    """The same model in another frame."""
    return replace(model, features=replace(model.features, gain=frame["gain"], offset_um=frame["offset_um"]))


# --- Snapshots: a model as a service holds it, with its memory and what stands in for it.


@dataclass(frozen=True)
class Snapshot:
    """One model of one snapshot, and the settings of its axis that a follower needs."""

    file: str
    name: str
    model: InverseModel
    seq: int = 4000
    stand_in: InverseModel | None = None
    trust: float = 1.0
    default: str = LEARNING
    learn: str = LEARNING
    trouble: str = ""
    memory: FloatArray | None = field(default=None)

    @property
    def config(self) -> AxisConfig:
        """An axis with this model."""
        return AxisConfig("x", Path("x.npz"), LIMITS, served=self.default, learn=self.learn)

    def served(self) -> Served:
        """The snapshot with the memories after a fixed motion."""
        models = {self.name: self.model}
        if self.stand_in is not None:
            models[self.stand_in.name] = self.stand_in
        memories = {name: moved(model) for name, model in models.items()}
        if self.memory is not None:
            memories[self.name] = self.memory
        other = "" if self.stand_in is None else self.stand_in.name
        return Served(self.seq, self.seq * DT_S, 3.0, models, memories, self.default, other, self.trust)

    def payload(self) -> bytes:
        """The message of kind 6."""
        served, config = self.served(), self.config
        learning = learns(self.name, config)
        safety = Safety(
            blends(self.name, self.default, config), config.blend_share, self.trust if learning else 1.0,
            config.stale_s if learning else 0.0, config.last_good_s, served.standing_in_for(self.name),
            self.trouble,
        )  # fmt: skip
        return encode_model(self.name, self.model, self.seq, served.memories[self.name], safety)

    def answer(self, query: bytes, age_s: float, limits: Limits = LIMITS) -> Trajectory:
        """What the service answers to ``query``."""
        age_s = 0.0 if math.isnan(age_s) else age_s
        config = replace(self.config, limits=limits)
        with np.errstate(over="ignore"):  # one model overflows on purpose
            return answer(decode_query(query), (self.served(),), self.seq, config, limits, age_s)


def moved(model: InverseModel) -> FloatArray:
    """The memory of ``model`` after a turn: not the memory of any rest."""
    y = np.array([5.0, 30.0, 62.0, 70.0, 55.0, 41.0, 38.0])
    return model.track(y, np.zeros(y.size), np.zeros(y.size), y / 11.0, model.rest_memory(5.0))


def snapshots() -> dict[str, Snapshot]:
    """All snapshots by file name."""
    rng = np.random.default_rng(SEED)
    small = lssvm(rng, feature_map(3, (3.0, 9.0), (0.1, 1.0, 10.0), (0, 2)), 40, True)
    bare = lssvm(rng, feature_map(0, (), (), ()), 25, False)
    arcless = lssvm(rng, replace(feature_map(4, (), (0.5,), (3, 1, 0)), asymmetric=False), 37, False)
    full = lssvm(rng, feature_map(24, (4.5, 13.5, 40.5), (0.1, 0.4, 1.6, 6.3, 25.0, 100.0), (5, 11, 17)), 500, True)
    zero_order = replace(BOUC_WEN, parameters=replace(BOUC_WEN.parameters, hold="zero_order"))
    flat = replace(BOUC_WEN, parameters=replace(BOUC_WEN.parameters, beta_per_V=0.3, gamma_per_V=0.3))
    pi = MpiInverse(MpiParameters((0.0, 0.7, 1.9), (8.0, -0.5, 2.2), lag_s=0.0), DT_S, DOMAIN)
    names = (LEARNING, "linear", "mpi", "bouc_wen")

    def auto(learnt: LssvmInverse, champion: int) -> ChampionInverse:
        return ChampionInverse(names, (learnt, LINE, MPI, BOUC_WEN), champion, 0.02)

    jumped = in_frame(full, JUMPED)
    half = auto(jumped, 2)
    shared = moved(half)
    shared[:4] = 0.55, 0.05, 0.15, 0.25

    def best(file: str, model: ChampionInverse, seq: int, memory: FloatArray | None = None) -> Snapshot:
        return Snapshot(file, AUTO, model, seq, stand_in=MPI, default=AUTO, memory=memory)

    made = [
        Snapshot("linear", "linear", LINE),
        Snapshot("linear-unknown-std", "linear", replace(LINE, voltage_std_V=math.nan), default="linear", learn=""),
        Snapshot("bouc_wen", "bouc_wen", BOUC_WEN),
        Snapshot("bouc_wen-zero-order", "bouc_wen", zero_order),
        Snapshot("bouc_wen-flat", "bouc_wen", flat),
        Snapshot("bouc_wen-troubled", "bouc_wen", BOUC_WEN, trouble="sensor_stuck"),
        Snapshot("mpi", "mpi", MPI),
        Snapshot("pi", "mpi", pi),
        Snapshot("lssvm", LEARNING, small, stand_in=MPI),
        Snapshot("lssvm-jumped", LEARNING, in_frame(small, JUMPED), seq=4500, stand_in=BOUC_WEN),
        Snapshot("lssvm-bare", LEARNING, bare, stand_in=LINE),
        Snapshot("lssvm-without-arcs", LEARNING, in_frame(arcless, JUMPED)),
        Snapshot("lssvm-distrusted", LEARNING, in_frame(small, JUMPED), seq=4500, stand_in=BOUC_WEN, trust=0.4),
        Snapshot("lssvm-troubled", LEARNING, in_frame(small, JUMPED), seq=4500, trouble="sensor_stuck"),
        Snapshot("lssvm-compared", "lssvm", replace(small, name="lssvm"), stand_in=MPI),
        Snapshot("overflowing", "linear", replace(LINE, parameters=LinearParameters(1e-307, 1.0)), stand_in=MPI),
        Snapshot("overflowing-alone", "linear", replace(LINE, parameters=LinearParameters(1e-307, 1.0))),
        best("auto", auto(full, 0), 4000),
        best("auto-jumped", auto(jumped, 0), 4060),
        best("auto-champion-changed", half, 4120),
        best("auto-in-change", half, 4120, shared),
    ]  # fmt: skip
    return {snapshot.file: snapshot for snapshot in made}


# --- Queries.


#: y µm, v µm/s, a µm/s², (n,) each; the last may be missing.
Points = tuple[FloatArray, FloatArray, FloatArray] | tuple[FloatArray, FloatArray]


def motion(
    n: int, start: int = 0, centre_um: float = 45.0, swing_um: float = 34.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(y, v, a), (n,) each, with turns of several sizes: polynomials of the number, so that every machine agrees."""
    t = (np.arange(start, start + n) % 40) / 20.0 - 1.0  # -1 to 1, a jump of 2 each 40 points
    y = centre_um + swing_um * (1.5 * t - 0.9 * t * t * t + 0.3 * t * t - 0.1)
    slope = swing_um * (1.5 - 2.7 * t * t + 0.6 * t)
    return y, slope * 50.0, swing_um * (0.6 - 5.4 * t) * 2500.0


@dataclass(frozen=True)
class Case:
    """A query to a snapshot. ``continues`` names the case whose reply it continues from."""

    name: str
    snapshot: str
    query: Callable[[Trajectory | None], bytes]
    age_s: float = math.nan
    continues: str = ""
    limits: Limits = LIMITS


def asks(
    points: Points, model: str, u_before_V: float = math.nan, pending: Pending | None = None
) -> Callable[[Trajectory | None], bytes]:
    """A query that continues from the reply that it is given, if any."""

    def query(before: Trajectory | None) -> bytes:
        memory, last_V = (None, u_before_V) if before is None else (before.memory, float(before.u_V[-1]))
        a = points[2] if len(points) == 3 else None
        return encode_query(points[0], points[1], a, memory, model, u_before_V=last_V, pending=pending)

    return query


def cases() -> list[Case]:
    """All cases, each after the one that it continues."""
    made = [
        Case(f"{file}-30", file, asks(motion(30), snapshot.name))
        for file, snapshot in snapshots().items()
    ]  # fmt: skip
    outside = motion(40, centre_um=52.0, swing_um=78.0)
    y, v, _ = motion(12)
    made += [
        Case("lssvm-outside", "lssvm", asks(outside, LEARNING)),
        Case("lssvm-jumped-outside", "lssvm-jumped", asks(outside, LEARNING)),
        Case("lssvm-without-arcs-outside", "lssvm-without-arcs", asks(outside, LEARNING)),
        Case("lssvm-compared-outside", "lssvm-compared", asks(outside, "lssvm")),
        Case("auto-outside", "auto-jumped", asks(outside, AUTO)),
        Case("auto-in-change-outside", "auto-in-change", asks(outside, AUTO)),
        Case("lssvm-fast", "lssvm-jumped", asks((y, 30.0 * v, np.zeros(12)), LEARNING)),
        Case("lssvm-slew", "lssvm", asks(motion(30), LEARNING, 9.5), limits=replace(LIMITS, slew_V_per_s=350.0)),
        Case(
            "lssvm-narrow", "lssvm", asks(motion(30), LEARNING, 5.0), limits=replace(LIMITS, u_min_V=3.0, u_max_V=5.5)
        ),
        Case("lssvm-without-accelerations", "lssvm-jumped", asks((y, v), LEARNING)),
        Case("overflowing-held", "overflowing-alone", asks(motion(3), "linear", 2.5)),
        Case("lssvm-fresh", "lssvm-jumped", asks(motion(8), LEARNING), 1.9),
        Case("lssvm-stale", "lssvm-jumped", asks(motion(8), LEARNING), 3.0),
        Case("lssvm-giving-way", "lssvm-jumped", asks(motion(8), LEARNING), 60.375),
        Case("lssvm-given-way", "lssvm-jumped", asks(motion(8), LEARNING), 62.0),
        Case("auto-giving-way", "auto-jumped", asks(outside, AUTO), 60.5),
    ]
    y, v, a = motion(10, 24)
    way_um, way_V = motion(24)[0], motion(24)[0] / 11.2
    for file, first in (
        ("linear", 3990), ("bouc_wen", 3990), ("mpi", 3995), ("lssvm", 3990), ("lssvm-jumped", 4501),
        ("auto-jumped", 4055), ("auto-in-change", 4121),
    ):  # fmt: skip
        pending = Pending(first, way_um, way_V)
        made.append(Case(f"{file}-under-way", file, asks((y, v, a), snapshots()[file].name, way_V[-1], pending)))
    for name, first in (("after-a-gap", 4700), ("last-seen", 4477), ("all-seen", 4476)):
        pending = Pending(first, way_um, way_V)
        made.append(Case(f"lssvm-jumped-{name}", "lssvm-jumped", asks((y, v, a), LEARNING, way_V[-1], pending)))
    beyond = motion(10, 30, 60.0, 75.0)
    made.append(
        Case("lssvm-under-way-stale", "lssvm", asks(beyond, LEARNING, 5.0, Pending(3995, way_um, way_V)), 60.25)
    )
    # A follower along one motion: the model is replaced by one after a jump, then by one with another champion.
    before, at = "", 0
    for i, (file, n) in enumerate(
        [("auto", 25), ("auto", 1), ("auto-jumped", 1), ("auto-jumped", 25), ("auto-champion-changed", 7),
         ("auto-champion-changed", 5), ("auto-champion-changed", 1), ("auto-champion-changed", 20), ("auto", 10)]
    ):  # fmt: skip
        name = f"follow-{i}"
        made.append(Case(name, file, asks(motion(n, at), AUTO), continues=before))
        before, at = name, at + n
    return made


# --- Changes of a followed model: a base and what comes after it, in order.


class Step(NamedTuple):
    """One message to a follower of changes. ``message``: "fetched" or "change"; ``base``, ``seq`` : checksum of the
    whole model, and last sample, of the model that the follower has afterwards."""

    name: str
    message: str
    payload: bytes
    outcome: str
    base: int
    seq: int
    reply: bytes = b""


def delta_query() -> bytes:
    """The query that the models of `delta_steps` answer."""
    return asks(motion(12), AUTO)(None)


def delta_steps() -> list[Step]:
    """A stage whose gain drops, whole models in between; changes of other whole models, and what is refused."""
    rng = np.random.default_rng(SEED + 1)
    learnt = lssvm(rng, feature_map(3, (3.0, 9.0), (0.1, 1.0, 10.0), (0, 2)), 40, True)
    learnt = replace(learnt, beta_covariance=np.empty((0, 0)))

    def auto(model: LssvmInverse, seq: int, trust: float = 1.0, champion: int = 0) -> Snapshot:
        made = ChampionInverse((LEARNING, "linear", "mpi", "bouc_wen"), (model, LINE, MPI, BOUC_WEN), champion, 0.02)
        # Plain arithmetic: the checksums are the same on every machine.
        memory = np.concatenate((np.eye(4)[champion], 5.0 + 0.125 * np.arange(made.memory_size - 4)))
        memory[4:] += (seq - 4000) / 64.0
        return Snapshot("deltas", AUTO, made, seq, MPI, trust, AUTO, memory=memory)

    def learning(now: Snapshot) -> LssvmInverse:
        assert isinstance(now.model, ChampionInverse)
        model = now.model.models[0]
        assert isinstance(model, LssvmInverse)
        return model

    def change(whole: Snapshot, now: Snapshot, **wrong: Any) -> bytes:
        model, served = learning(now), now.served()
        frame, memory = model.features, wrong.pop("memory", served.memories[AUTO])
        part = MovingPart(frame.gain, frame.offset_um, model.beta, model.domain, model.noise_variance, memory, None)
        return encode_delta(now.seq, checksum(whole.payload()), part._replace(**wrong), memory)

    def moved(model: LssvmInverse, gain: float, offset_um: float) -> LssvmInverse:
        beta = model.beta + rng.uniform(-1e-3, 1e-3, model.beta.size)
        frame = {"gain": gain, "offset_um": offset_um}
        return replace(in_frame(model, frame), beta=beta, noise_variance=model.noise_variance * 1.25)

    base = auto(learnt, 4000)
    frame = auto(moved(learnt, 0.98, 0.4), 4005)
    linear = auto(moved(learnt, 0.94, 1.8), 4010)
    grown = np.concatenate([learnt.support, rng.uniform(-1.2, 1.2, (2, 4))])
    grown[[3, 17]] = rng.uniform(-1.2, 1.2, (2, 4))
    second = replace(moved(learnt, 0.94, 1.8), support=grown, alpha=rng.uniform(-0.4, 0.4, 42), gamma=300.0)
    kernel = auto(second, 4020, 0.7)
    after_kernel = auto(moved(second, 0.941, 1.8), 4025, 0.7)
    missed = auto(moved(second, 0.942, 1.8), 4040)
    after_missed = auto(moved(learning(missed), 0.943, 1.8), 4045)
    last = auto(moved(learning(missed), 0.944, 1.8), 4050)
    frozen = auto(replace(learnt, beta_covariance=1e-6 * np.eye(learnt.beta.size), noise_variance=2e-6), 4100)
    other = auto(learnt, 4120, champion=1)
    query = delta_query()

    def taken(name: str, now: Snapshot, whole: Snapshot, message: str = "change") -> Step:
        payload = now.payload() if now is whole else change(whole, now)
        reply = encode_reply(now.answer(query, math.nan))
        return Step(name, message, payload, "taken", checksum(whole.payload()), now.seq, reply)

    def left(name: str, payload: bytes, outcome: str, now: Snapshot, whole: Snapshot) -> Step:
        return Step(name, "change", payload, outcome, checksum(whole.payload()), now.seq)

    beta = learnt.beta
    wrong: dict[str, dict[str, Any]] = {
        "linear-part": {"beta": beta[:-1]},
        "memory": {"memory": np.zeros(3)},
        "not-finite": {"beta": np.full(beta.size, math.nan)},
        "noise": {"noise_variance": -1e-6},
    }
    return [
        taken("base", base, base, "fetched"),
        taken("frame", frame, base),
        taken("linear", linear, base),
        taken("kernel", kernel, kernel),
        left("older", change(base, linear), "lost", kernel, kernel),
        taken("after-kernel", after_kernel, kernel),
        left("gap", change(missed, after_missed), "lost", after_kernel, kernel),
        # The change that was left out is of it.
        taken("repaired", after_missed, missed)._replace(message="fetched", payload=missed.payload()),
        taken("last", last, missed),
        *(left(name, change(missed, last, **fields), "refused", last, missed) for name, fields in wrong.items()),
        taken("whole", frozen, frozen),
        taken("champion", other, other),
        left("nothing-moves", change(other, other), "refused", other, other),
    ]


# --- Files.


def refused() -> dict[str, tuple[bytes, int, str]]:
    """(payload, kind that is expected, field that the error names) by file name."""
    good = encode_query(40.0, 0.0, model="auto")
    pending = Pending(7, np.array([40.0, 41.0]), np.array([3.0, 3.1]))
    way = encode_query(40.0, 0.0, pending=pending)
    samples = encode_samples([5], [0.005], [1.0], [11.0])
    model = snapshots()["linear"].payload()
    nan = struct.pack("<d", math.nan)
    part = MovingPart(1.0, 0.0, np.array([1.0, 2.0]), np.arange(6.0), 1e-6, np.array([3.0]), None)
    delta = encode_delta(4, 7, part, part.memory)
    return {
        "version": (b"\x02" + good[1:], FEEDFORWARD_QUERY, "version"),
        "kind": (b"\x01\x05" + good[2:], FEEDFORWARD_QUERY, "kind"),
        "options": (good[:2] + b"\x08\x00" + good[4:], FEEDFORWARD_QUERY, "options"),
        "n": (good[:4] + bytes(4) + good[8:], FEEDFORWARD_QUERY, "n"),
        "as_of": (good[:8] + struct.pack("<q", -2) + good[16:], FEEDFORWARD_QUERY, "as_of"),
        "u_before_V": (good[:16] + struct.pack("<d", math.inf) + good[24:], FEEDFORWARD_QUERY, "u_before_V"),
        "m": (good[:24] + struct.pack("<I", 4097) + good[28:], FEEDFORWARD_QUERY, "m"),
        "b": (good[:28] + struct.pack("<I", 65) + good[32:], FEEDFORWARD_QUERY, "b"),
        "y_um": (good[:32] + nan + good[40:], FEEDFORWARD_QUERY, "y_um[0]"),
        "short-query": (good[:-1], FEEDFORWARD_QUERY, "payload"),
        "pending-first": (way[:48] + struct.pack("<q", -1) + way[56:], FEEDFORWARD_QUERY, "pending.first"),
        "pending-k": (way[:56] + bytes(4) + way[60:], FEEDFORWARD_QUERY, "pending.k"),
        "pending-y_um": (way[:60] + nan + way[68:], FEEDFORWARD_QUERY, "pending.y_um[0]"),
        "pending-u_V": (way[:-8] + nan, FEEDFORWARD_QUERY, "pending.u_V[1]"),
        "seq": (samples[:8] + struct.pack("<q", -1) + samples[16:], SAMPLES, "seq"),
        "long-samples": (samples + b"\x00", SAMPLES, "payload"),
        "command": (encode_command(5, [1.0])[:-8] + nan, COMMAND, "u_V[0]"),
        "short-model": (model[:-8], MODEL, "payload"),
        "arrays": (model[:4] + struct.pack("<I", 9) + model[8:], MODEL, "arrays"),
        "header": (model.replace(b'{"name"', b'["name"', 1), MODEL, "header"),
        "delta-options": (delta[:2] + b"\x02" + delta[3:], DELTA, "options"),
        "delta-n": (delta[:4] + bytes(4) + delta[8:], DELTA, "n"),
        "delta-seq": (delta[:8] + struct.pack("<q", -2) + delta[16:], DELTA, "snapshot_seq"),
        "delta-m": (delta[:20] + struct.pack("<I", 4097) + delta[24:], DELTA, "m"),
        "delta-values": (delta[:24] + nan + delta[32:], DELTA, "values[0]"),
        "delta-short": (delta[:-1], DELTA, "payload"),
        "delta-long": (delta + bytes(8), DELTA, "payload"),
    }


def plain_payloads() -> dict[str, tuple[bytes, list[tuple[str, list[float]]]]]:
    """(payload, values by field) of what has no answer, by file name."""
    seq, t_s, u_V, y_um = [1000.0, 1001.0, 1003.0], [1.0, 1.001, 1.003], [5.0, 5.25, 4.75], [40.25, math.nan, -0.125]
    return {
        "samples": (
            encode_samples([int(k) for k in seq], t_s, u_V, y_um),
            [("seq", seq), ("t_s", t_s), ("u_V", u_V), ("y_um", y_um)],
        ),
        "command": (encode_command(2**40, u_V), [("seq", [2.0**40]), ("u_V", u_V)]),
        "reference": (encode_reference(7, t_s), [("seq", [7.0]), ("y_um", t_s)]),
    }


def fleet_payloads() -> dict[str, tuple[int, dict[str, list[float] | list[list[float]]]]]:
    """Kind and parts of payloads of a fleet, of three axes from axis 2 on, by file name."""
    two = [[5.0, 5.25, 4.75], [5.5, math.nan, 4.5]]
    return {
        "samples": (
            FLEET_SAMPLES,
            {
                "seq": [1000, 1001],
                "t_s": [1.0, 1.001],
                "u_V": two,
                "y_um": [[40.25, math.inf, -0.125], [41.0, math.nan, 0.5]],
            },
        ),
        "query": (
            FLEET_QUERY,
            {
                "y_um": two,
                "v_um_per_s": [[1.0, 2.0, 3.0]] * 2,
                "a_um_per_s2": [[-8.0, 0.0, 0.25]] * 2,
                "memory": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
                "u_before_V": [0.5, math.nan, 1.5],
            },
        ),
        "query-alone": (FLEET_QUERY, {"y_um": two, "v_um_per_s": two, "a_um_per_s2": two}),
        "reply": (
            FLEET_REPLY,
            {
                "snapshot_seq": [2**40],
                "u_V": two,
                "std_V": [[0.125] * 3] * 2,
                "memory": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
                "flags": [[0, 1, 2], [4, 128, 0]],
            },
        ),
        "changes": (
            FLEET_CHANGES,
            {
                "snapshot_seq": [7],
                "axes": [3, 5, 900],
                "frames": [[1.0, 0.0], [0.94, 1.8], [1.5, -2.0]],
                "beta": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
            },
        ),
    }


#: Key of the authenticators, and a stamp of a query, of a service and of a stage.
SHARED: Final = b"0123456789abcdef0123456789abcdef"
ASKED, SERVICE, STAGE = (bytes(range(first, first + 16)) for first in (0x10, 0xA0, 0xE0))


def authenticators() -> list[str]:
    """Lines ``case kind key stamp parameters asked_stamp asked payload tag``; "-": none."""
    keys, tag = Keys("demo", "x"), Authenticator(SHARED).tag
    plain = {name: payload for name, (payload, _) in plain_payloads().items()}
    files = {"samples.payload": plain["samples"], "deltas.query.payload": delta_query()}
    files |= {f"deltas-{step.name}.{step.message}.payload": step.payload for step in delta_steps()}
    files |= {f"deltas-{step.name}.reply.payload": step.reply for step in delta_steps() if step.reply}
    first = next(step for step in delta_steps() if step.message == "change")
    change, whole, reply = (
        f"deltas-{first.name}.change.payload",
        "deltas-base.fetched.payload",
        "deltas-base.reply.payload",
    )
    rows = (
        ("point", "reply", keys.feedforward, SERVICE, "", ASKED, "deltas.query.payload", reply),
        ("model", "reply", keys.model, SERVICE, "name=auto;changes=1", ASKED, "-", whole),
        ("change", "put", keys.champion_delta, SERVICE, "", b"", "-", change),
        ("samples", "put", keys.sample, STAGE, "", b"", "-", "samples.payload"),
        ("state", "query", keys.state, ASKED, "pause_s=0.001", b"", "-", "-"),
        ("claim", "claim", keys.token("claim", "2/i4711-ab12cd34"), b"", "", b"", "-", "-"),
    )
    table = [f"# secret {SHARED.hex()}", "# case kind key stamp parameters asked_stamp asked payload tag"]
    for case, kind, key, stamp, parameters, asked_stamp, asked, payload in rows:
        said, query = files.get(payload, b""), files.get(asked, b"")
        parts = {
            "reply": (key, stamp, asked_stamp, parameters, query, said),
            "put": (key, stamp, said),
            "query": (key, stamp, parameters, said),
            "claim": (key,),
        }[kind]
        cells = (case, kind, key, stamp.hex(), parameters, asked_stamp.hex(), asked, payload, tag(kind, *parts).hex())
        table.append(" ".join(cell or "-" for cell in cells))
    return table


#: Settings of the corrections in the vectors, as in a status.
CORRECTION: Final = CorrectionConfig(on=True, share=0.004, mode_Hz=200.0, fade_s=0.05)
REPETITION: Final = RepetitionConfig(on=True, share=0.1, mode_Hz=200.0, fade_s=0.05)


@dataclass(frozen=True)
class Corrected:
    """What a follower that corrects is asked for and given, sample after sample.

    model : file of the first snapshot. y_um, v_um_per_s : (n,) motion. reading : (sample, its reading, µm) that comes
    before sample k, or None, from k and the voltages that the samples before it got beyond the model's answers, V.
    changes : file of a snapshot that comes before a sample. periods : what is stated before a sample, s; None: find it.
    repetition : settings; None: off.
    """

    model: str
    y_um: FloatArray
    v_um_per_s: FloatArray
    reading: Callable[[int, list[float]], tuple[int, float] | None]
    changes: dict[int, str] = field(default_factory=dict)
    periods: dict[int, float | None] = field(default_factory=dict)
    repetition: RepetitionConfig | None = None

    def lines(self) -> list[str]:
        """The table that docs/protocol.md describes."""
        made, correcting = snapshots(), Correcting(CORRECTION, LIMITS, DT_S, self.repetition)
        integral, repetition = correcting.correction, correcting.repetition
        assert integral is not None
        now, memory, u_V = made[self.model], moved(made[self.model].model), math.nan
        off = RepetitionConfig(share=math.nan, mode_Hz=math.nan, fade_s=math.nan)
        each = CORRECTION, self.repetition or off
        settings = " ".join(f"{one.share!r} {one.mode_Hz!r} {one.fade_s!r}" for one in each)
        columns = "seq y_um v_um_per_s change period_s read_seq read_um u_V age integral_V halved doubted"
        table = [f"# {self.model}.model.payload {settings}", f"# {columns} repetition_V halved doubted period active"]
        added_V: list[float] = []
        for k, (y_um, v_um_per_s) in enumerate(zip(self.y_um.tolist(), self.v_um_per_s.tolist(), strict=True)):
            change, period_s, reading = self.changes.get(k), "-", self.reading(k, added_V)
            now = now if change is None else made[change]
            if repetition is not None and k in self.periods:
                stated = self.periods[k]
                repetition.state(stated)
                period_s = "nan" if stated is None else repr(stated)
            if reading is not None:
                correcting.read(*([value] for value in reading))
            model, points = now.model, (np.array([y_um]), np.array([v_um_per_s]), np.zeros(1))
            got = model.feedforward(*points, memory)
            answered = got.u_V, got.std_V.item()
            wanted_V = got.u_V + correcting.voltage(k, model, points, memory, answered, now.trouble)
            step_V = LIMITS.slew_V_per_s * DT_S
            u_V, flags = limit_voltage(wanted_V.item(), u_V, LIMITS.u_min_V, LIMITS.u_max_V, step_V)
            correcting.applied(k, np.array([u_V]))
            if flags or not got.inside[0]:
                correcting.leave_out(k, np.ones(1))
            added_V.append(u_V - got.u_V.item())
            memory, file = got.memory, "-" if change is None else f"{change}.model.payload"
            row = [k, y_um, v_um_per_s, file, period_s, *(reading or ("-", math.nan)), u_V, correcting.age]
            row += [integral.u_V, integral.halved, integral.doubted]
            if repetition is None:
                row += [0.0, 0, 0, math.nan, 0]
            else:
                period = math.nan if repetition.period is None else repetition.period
                row += [repetition.u_V, repetition.halved, repetition.doubted, period, int(repetition.active)]
            table.append(" ".join(map(str, row)))
        return table


def corrected_by_integral() -> Corrected:
    """A slow way up, and rest: readings that are late, doubted, missing, or oscillate; new models; a trouble."""
    k = np.arange(1200)
    y = np.where(k < 700, 40.0 + 0.01 * k, 47.0)
    noise_um = 0.003 * (k * 7919 % 13 - 6) / 6.0

    def reading(k: int, added_V: list[float]) -> tuple[int, float] | None:
        if k < 3 or 300 <= k < 380:
            return None
        seen = k - (1 if k < 100 else 3)
        read_um = float(y[seen] - 0.03 + noise_um[k])
        read_um += 5.0 if k in (60, 61, 250) else 0.0
        read_um += 0.2 * (1.0 if k % 20 < 10 else -1.0) if 500 <= k < 680 else 0.0
        return seen, read_um

    changes = {400: "lssvm-jumped", 900: "lssvm", 1000: "lssvm-jumped", 1100: "lssvm-troubled"}
    return Corrected("lssvm", y, np.where(k < 700, 10.0, 0.0), reading, changes)


def corrected_by_repetition() -> Corrected:
    """A wave, one of another amplitude, another motion of a period that is stated, and its end.

    The stage follows the voltage two and a half samples later, and is off by a wave of the same period. Readings are
    doubted, missing, of other ages, and doubted for long; the error grows at once; a trouble comes and goes.
    """
    k = np.arange(1720)
    # Of 40.4 samples and 25.25.
    first, second = (2.0 * np.pi * k / period for period in (40.4, 25.25))
    swing_um = np.where(k < 420, 10.0, 12.0)
    y = np.where(k < 760, 45.0 + swing_um * np.sin(first), 50.0 + 6.0 * np.sin(second) + 2.0 * np.sin(2.0 * second))
    y = np.round(np.where(k < 1650, y, y[1650]), 3)
    v = np.round(np.gradient(y) / DT_S, 1)
    off_um = np.where(k < 760, np.sin(2.0 * first), np.where(k < 1150, 1.0, 8.0) * np.sin(second + 0.7))
    off_um = np.round(0.06 * off_um + 0.004 * (k * 7919 % 13 - 6) / 6.0, 4)

    def reading(k: int, added_V: list[float]) -> tuple[int, float] | None:
        seen = k - (4 if 350 <= k < 400 else 1)
        if seen < 0 or 310 <= k < 330 or k % 97 == 5:
            return None
        followed_um = 11.0 * np.mean(added_V[max(seen - 3, 0) : max(seen - 1, 1)])
        read_um = round(float(y[seen] - off_um[seen] + followed_um), 4)
        return seen, read_um + (30.0 if k == 290 or 1480 <= k < 1540 else 0.0)

    changes = {600: "bouc_wen-zero-order", 1400: "bouc_wen-troubled", 1405: "bouc_wen"}
    return Corrected("bouc_wen", y, v, reading, changes, {760: 25.25 * DT_S, 1700: None}, REPETITION)


def write(out: Path) -> int:
    """Write all files to ``out``, which is created; returns the bytes written."""
    out.mkdir(parents=True, exist_ok=True)
    for old in (*out.glob("*.payload"), *out.glob("*.txt")):
        old.unlink()
    files: dict[str, bytes] = {}
    known = snapshots()
    files |= {f"{file}.model.payload": snapshot.payload() for file, snapshot in known.items()}
    replies: dict[str, Trajectory] = {}
    table = [f"# {COLUMNS}"]
    for case in cases():
        query = case.query(replies.get(case.continues))
        replies[case.name] = reply = known[case.snapshot].answer(query, case.age_s, case.limits)
        files |= {f"{case.name}.query.payload": query, f"{case.name}.reply.payload": encode_reply(reply)}
        names = (f"{case.snapshot}.model.payload", f"{case.name}.query.payload", f"{case.name}.reply.payload")
        limits = case.limits
        bounds = (limits.u_min_V, limits.u_max_V, limits.slew_V_per_s, limits.y_min_um, limits.y_max_um, case.age_s)
        table.append(" ".join((case.name, *names, case.continues or "-", *(repr(value) for value in bounds))))
    files["cases.txt"] = ("\n".join(table) + "\n").encode()
    table = ["# file field index value"]
    for name, (payload, columns) in plain_payloads().items():
        files[f"{name}.payload"] = payload
        table += [f"{name}.payload {key} {i} {value!r}" for key, values in columns for i, value in enumerate(values)]
    files["payloads.txt"] = ("\n".join(table) + "\n").encode()
    table = ["# file field index value"]
    for name, (kind, parts) in fleet_payloads().items():
        files[f"fleet-{name}.payload"] = encode_fleet(kind, 0 if name == "changes" else 2, **parts)
        for key, given in parts.items():
            values = np.ravel(given).tolist()
            table += [f"fleet-{name}.payload {key} {i} {float(value)!r}" for i, value in enumerate(values)]
    files["fleet.txt"] = ("\n".join(table) + "\n").encode()
    table = ["# step message file outcome base snapshot_seq"]
    files["deltas.query.payload"] = delta_query()
    for step in delta_steps():
        file = f"deltas-{step.name}.{step.message}.payload"
        files[file] = step.payload
        if step.reply:
            files[f"deltas-{step.name}.reply.payload"] = step.reply
        table.append(f"{step.name} {step.message} {file} {step.outcome} {step.base:08x} {step.seq}")
    files["deltas.txt"] = ("\n".join(table) + "\n").encode()
    table = ["# file kind field"]
    for name, (payload, kind, at) in refused().items():
        files[f"refused-{name}.payload"] = payload
        table.append(f"refused-{name}.payload {kind} {at}")
    files["refused.txt"] = ("\n".join(table) + "\n").encode()
    for name, corrected in (("correction", corrected_by_integral()), ("repetition", corrected_by_repetition())):
        files[f"{name}.txt"] = ("\n".join(corrected.lines()) + "\n").encode()
    files["authenticators.txt"] = ("\n".join(authenticators()) + "\n").encode()
    for name, payload in files.items():
        (out / name).write_bytes(payload)
    return sum(map(len, files.values()))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=DEFAULT_OUT, help="folder (docs/protocol/vectors)")
    out = parser.parse_args().out
    print(f"{out}: {len(cases())} cases, {write(out) / 1000:.0f} kB")


if __name__ == "__main__":
    main()
