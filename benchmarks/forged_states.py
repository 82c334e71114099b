"""Forged states of an axis: valid checkpoints with a few entries replaced, as a stranger or a broken disk makes them.

A forged state has a correct digest and a correct container. Only its content is wrong: an array is emptied, cut, of
another type, or full of NaN; a count is huge. `Victims.take` restores an axis from one and lets it learn and answer.
Compiled code reads arrays without checks of bounds, so that a state that is not refused may end the process: run it in
a process of its own.

::

    python -m benchmarks.forged_states --count 400 --seed 1 --out FILE    # one JSON line for each forged state
"""

from __future__ import annotations

import argparse
import json
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.types import FloatArray, InverseModel, StateDict
from dehyst.baselines.bouc_wen.model import TABLE_2_1, BoucWenInverse
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse, LinearParameters
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, MpiParameters
from dehyst.service.answers.guard import Limits
from dehyst.service.config.settings import AxisConfig
from dehyst.service.failover.standby_model import StandbyModel
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.checkpoint import CheckpointFolder, CheckpointMeta, encode_checkpoint, restore_newest
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.service.conftest import make_models

DT_S: Final = 1e-3
#: Samples before a state is copied, and after it was taken; samples of a batch.
_BEFORE, _AFTER, _BATCH = 1200, 160, 20
_MPI: Final = MpiParameters((0.0, 1.0, 3.0), (8.0, 2.0, 1.0), (0.0, 20.0), (1.0, 0.1))


def bundle() -> Bundle:
    """Four models of one stage of 11 µm/V, one of each kind that learns."""
    seen = Domain(0.0, 90.0, 1e4)
    found: dict[str, InverseModel] = {
        "lssvm_adaptive": make_models()["lssvm_adaptive"],
        "linear": LinearInverse(LinearParameters(11.0, 1.0), DT_S, seen, 0.05),
        "mpi": MpiInverse(_MPI, DT_S, seen, 0.01),
        "bouc_wen": BoucWenInverse(TABLE_2_1, DT_S, seen, 0.01),
    }
    return Bundle(found, BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0))


def make_axis(alone: bool = False) -> Axis:
    """An axis with a window of 60 samples that serves `bundle`; ``alone``: without a competition."""
    compete = () if alone else ("linear", "mpi", "bouc_wen")
    limits = Limits(0.0, 10.0, 2000.0, 0.0, 90.0)
    learner: dict[str, Any] = {"window": 60}
    return load_axis("demo", AxisConfig("x", Path("x.npz"), limits, compete=compete, learner=learner), bundle=bundle())


def recording(first: int, n: int, fault: str = "") -> SampleBatch:
    """n samples of a stage with 5 % less gain than the models believe; ``fault``: "stuck" or "jumped"."""
    k = np.arange(first, first + n)
    y: FloatArray = 45.0 + 25.0 * np.sin(2 * np.pi * 3.0 * k * DT_S) + 10.0 * np.sin(2 * np.pi * 11.0 * k * DT_S)
    t_s = np.asarray(k * DT_S, dtype=np.float64)
    u = (y - 1.0) / (11.0 * 0.95)
    if fault == "stuck":
        y = 50.0 + 1e-3 * np.sin(1.7 * k)
    elif fault == "jumped":
        y = y + 9.0
    return SampleBatch(k, t_s, u, y)


def _state_after(axis: Axis, fault: str, n: int) -> StateDict:
    for first in range(0, _BEFORE, _BATCH):
        axis.handle(recording(first, _BATCH))
    axis.handle(recording(_BEFORE, n, fault))
    return axis.state_dict()


class Victims:
    """Valid states of axes in several situations, and axes that take forged ones."""

    def __init__(self) -> None:
        self.axes = {True: make_axis(alone=True), False: make_axis()}
        healing = make_axis(alone=True)
        for first in range(0, _BEFORE, _BATCH):
            healing.handle(recording(first, _BATCH))
        learner: Any = healing.learner
        learner.parts.window._healing.begin()
        #: By situation: (without a competition, state).
        self.states: dict[str, tuple[bool, StateDict]] = {
            "competing": (False, _state_after(make_axis(), "", 13)),
            "competing_stuck": (False, _state_after(make_axis(), "stuck", 400)),
            "alone": (True, _state_after(make_axis(alone=True), "", 13)),
            "stuck": (True, _state_after(make_axis(alone=True), "stuck", 200)),
            "poisoned": (True, _state_after(make_axis(alone=True), "stuck", 1200)),
            "jumped": (True, _state_after(make_axis(alone=True), "jumped", 9)),
            "healing": (True, healing.state_dict()),
        }

    def take(self, alone: bool, state: StateDict, over_wire: bool) -> str:
        """Restore an axis from ``state`` and work with it. Returns "taken", or the reason of the refusal.

        Raises whatever the axis raises; a state may also end the process.
        """
        axis = self.axes[alone]
        axis.take_events()
        meta = CheckpointMeta("demo", "x", DT_S, 1, 1, models=axis.identified)
        if over_wire:
            try:
                StandbyModel(axis, None).take_state(b"".join(encode_checkpoint(meta, state)))
            except ModelFileError as error:
                return f"refused: {error}"
        else:
            with tempfile.TemporaryDirectory() as directory:
                folder = CheckpointFolder(Path(directory), "demo", "x", DT_S, axis.identified, 4)
                folder.write(meta, state)
                if restore_newest(axis, folder) is None:
                    return f"refused: {axis.take_events()[-1]['detail']}"
        return self._work(axis)

    def _work(self, axis: Axis) -> str:
        first = max(axis.sequence.last, 0) % 2**31 + 1
        for start in range(first, first + _AFTER, _BATCH):
            axis.handle(recording(start, _BATCH))
            for name in axis.newest.models:
                reply = axis.answer(FeedforwardQuery(np.array([40.0, 41.0]), np.zeros(2), np.zeros(2), model=name))
                if not (np.isfinite(reply.u_V).all() and (reply.u_V >= 0.0).all() and (reply.u_V <= 10.0).all()):
                    raise AssertionError(f"{name} answers {reply.u_V}")
        encode_checkpoint(CheckpointMeta("demo", "x", DT_S, 1, 1), axis.state_dict())
        failed = [event["detail"] for event in axis.take_events() if event["event"] == "learner_failed"]
        return f"failed: {failed[0]}" if failed else "taken"


# --- Forging.


VALUES: Final[tuple[Any, ...]] = (
    -1, 0, 1, 7, 2**31, 2**62, 2**63, 10**30, -(2**62), -1e308, 1e308, 5e-324, 0.5, True, None, "", "nan", "sorcery",
    [], [1, 2], {}, np.array(np.nan), np.array(np.inf), np.zeros(0), np.zeros((3, 3)), np.array(-(2**63)),
)  # fmt: skip


#: What is done to an array.
CHANGES: Final[tuple[Callable[[np.ndarray[Any, Any]], np.ndarray[Any, Any]], ...]] = (
    lambda value: np.zeros((0,) * max(value.ndim, 1), value.dtype),
    lambda value: value[: value.shape[0] // 2].copy() if value.ndim else value[None],
    lambda value: value[..., :-1].copy() if value.ndim else value[None],
    lambda value: np.concatenate([value, value]) if value.ndim else np.array([value, value]),
    lambda value: value.astype("<i4"),
    lambda value: value.astype("|u1"),
    lambda value: value.astype("<f4"),
    lambda value: np.full(value.shape, np.nan),
    lambda value: np.full(value.shape, np.inf),
    lambda value: np.full(value.shape, 1e300),
    lambda value: np.full(value.shape, 2**62),
    lambda value: np.full(value.shape, -(2**40)),
    lambda value: value[None],
    lambda value: value.ravel(),
    lambda value: value.T.copy() if value.ndim > 1 else value.reshape(-1, 1),
)


#: Bytes of one edit of `edited`: number of the entry, number of the change, and a value.
EDIT: Final = struct.Struct("<HB8s")
#: The change that removes an entry; those just before it put a number of any size there.
REMOVED: Final = len(CHANGES) + len(VALUES) + 3
#: Most edits of one state.
MOST_EDITS: Final = 8


def edited(state: StateDict, data: bytes) -> StateDict:
    """A copy of ``state`` with entries replaced as ``data`` says, so that a fuzzer reaches every entry by few bytes."""
    made, names = dict(state), list(state)
    for at in range(0, min(len(data), MOST_EDITS * EDIT.size) - EDIT.size + 1, EDIT.size):
        entry, change, raw = EDIT.unpack_from(data, at)
        name = names[entry % len(names)]
        value, number = state[name], np.frombuffer(raw, dtype="<f8")
        what = change % (REMOVED + 1)
        if what < len(CHANGES):
            numeric = np.asarray(value).dtype.kind in "fiub"
            made[name] = CHANGES[what](np.asarray(value)) if numeric else VALUES[raw[0] % len(VALUES)]
        elif what < len(CHANGES) + len(VALUES):
            made[name] = VALUES[what - len(CHANGES)]
        elif what == REMOVED:
            made.pop(name, None)
        elif what == REMOVED - 1 and isinstance(value, np.ndarray) and value.size:
            made[name] = value.astype(np.float64)
            made[name].flat[raw[0] * value.size // 256] = number[0]
        else:
            made[name] = float(number[0]) if what == REMOVED - 2 else int.from_bytes(raw, "little", signed=True)
    return made


def forged(state: StateDict, rng: np.random.Generator) -> tuple[StateDict, str]:
    """A copy of ``state`` with one to three entries replaced, and their names."""
    # Numbers of any size are for the fuzzer.
    kinds = [*range(len(CHANGES) + len(VALUES)), REMOVED]
    edits = [(rng.integers(2**16), rng.choice(kinds), rng.bytes(8)) for _ in range(rng.choice([1, 1, 2, 3]))]
    made = edited(state, b"".join(EDIT.pack(*edit) for edit in edits))
    return made, ", ".join(name for name in state if made.get(name) is not state[name])


def main() -> None:
    """Work through forged states; a line is written before and after each, so that a crash shows which it was."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.forged_states", description=__doc__.split("\n", 1)[0])
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE")
    args = parser.parse_args()
    victims = Victims()
    situations = list(victims.states)
    with np.errstate(all="ignore"), open(args.out, "a", encoding="utf-8", buffering=1) as out:
        for number in range(args.first, args.count):
            rng = np.random.default_rng([args.seed, number])
            situation = situations[number % len(situations)]
            alone, state = victims.states[situation]
            bad, what = forged(state, rng)
            entry = {"number": number, "situation": situation, "what": what}
            out.write(json.dumps({**entry, "outcome": "begun"}) + "\n")
            try:
                outcome = victims.take(alone, bad, over_wire=number % 2 == 1)
            except Exception as error:
                outcome = f"raised: {type(error).__name__}: {error}"
                victims.axes[alone] = make_axis(alone)
            out.write(json.dumps({**entry, "outcome": outcome}) + "\n")


if __name__ == "__main__":
    main()
