"""The state of an axis as flat entries: what a checkpoint keeps, and what a standby takes over from the one it backs.

With it a second process goes on from a sample as the first does, to the last bit. Models that came from the model file
are not in it; the learner is, with what it began from, so that a state of another model can be told and refused.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.state_codec import prefixed, under
from adaptive.types import FloatArray, InverseModel, OnlineModel, StateDict
from service.answers.answering import Served
from service.background.retuning.adoption import Retuned
from service.intake.clock import SampleClock
from service.protocol.errors import FieldError
from service.protocol.model_classes import build_model, stored_kind
from service.server.competing import champion_of
from service.server.model_watch import POISON

if TYPE_CHECKING:
    from service.server.axis import Axis

#: Of what is written here; another one is refused.
STATE_SCHEMA: Final = 3
#: Parts of a learner's state that tell what it is and not what it has learnt: its settings, and of the model that it
#: began from what no re-tuning changes. They must be those of the present one.
_FIXED: Final = re.compile(r"(^|\.)(config\.|base\.(beta$|span_V$|features\.))")
#: Settings that states from before there were any lack; they had no such bounds.
_SINCE: Final = re.compile(r"(^|\.)config\.envelope\.")


def axis_state(axis: Axis) -> StateDict:
    """All that the samples have changed; copies. For the thread that handles samples."""
    served = axis.newest
    state: StateDict = {
        "seq": axis.handled_seq,
        "served.seq": served.seq,
        "served.t_s": served.t_s,
        "served.u_V": served.u_V,
        "served.default": served.default,
        "served.trust": served.trust,
        "served.trouble": served.trouble,
        "frozen_by": axis._frozen_by,
        "dead": axis._learner_dead,
        "adoptions": json.dumps([retuned.to_json() for retuned in axis.adoptions.pending]),
    }
    state |= prefixed("sequence.", axis.sequence.state_dict())
    state |= prefixed("clock.", axis.clock.state_dict())
    state |= prefixed("tracker.", axis.tracker.state_dict())
    state |= prefixed("gates.", axis.gates)
    state |= prefixed("memory.", served.memories)
    state |= prefixed("watch.", axis.watch.state_dict())
    for role, model in axis.watch.models().items():
        state |= {f"model.{role}.kind": stored_kind(model)}
        state |= prefixed(f"model.{role}.", model.state_dict())
    if served.trouble in POISON:
        # What the learner goes back to when the samples are good again.
        state |= prefixed("mark.", axis._marks[0])
    if axis.learner is not None:
        state |= prefixed("learner.", axis.learner.state_dict())
    return state


def restore_axis(axis: Axis, state: StateDict) -> None:
    """Go on from ``state``. Raises ModelFileError where it does not match the axis; the axis is then unchanged."""
    try:
        learner = None if axis.learner is None else restored_learner(under("learner.", state), axis.learner)
        watched = {role: _model(under(f"model.{role}.", state), role) for role in _roles(state)}
        served = _served(axis, state, learner, watched)
        parts = ("tracker.", "sequence.", "watch.", "clock.")
        tracker, sequence, watch, clock = (under(part, state) for part in parts)
        seq, frozen_by, dead = int(state["seq"]), str(state["frozen_by"]), bool(state["dead"])
        adoptions = [Retuned.from_json(entry, "adoptions") for entry in json.loads(str(state["adoptions"]))]
        # From here on nothing is looked up that may be missing but in these, which check before they change.
        going_on = SampleClock(axis.dt_s)
        going_on.restore(clock)
        axis.sequence.restore(sequence)
        axis.tracker.restore(tracker)
        axis.watch.restore(watch, watched)
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise ModelFileError(f"state: entry missing or damaged: {error!r}") from error
    axis.clock = going_on
    axis._gates = {name: int(count) for name, count in under("gates.", state).items()}
    axis._frozen_by, axis._learner_dead = frozen_by, dead
    axis.adoptions.replace(adoptions)
    axis.learner = learner
    # What was marked before was of another past.
    axis._marks, axis._marked = (under("mark.", state), {}), axis.sequence.received
    axis._ring = (served,)
    axis.handled_seq = seq
    axis.count()
    axis.set_teaching()


def restored_learner(state: StateDict, like: OnlineModel) -> OnlineModel:
    """A learner like ``like`` with ``state``. Raises ModelFileError with the reason why it does not match."""
    if not state:
        raise ModelFileError("it holds no learner, but this axis learns")
    own = like.state_dict()
    for name, value in own.items():
        if not _FIXED.search(name) or (name not in state and _SINCE.search(name)):
            continue
        if name not in state or not _same(value, state[name]):
            what = "setting" if "config." in name else "identified model"
            raise ModelFileError(
                f"it belongs to another {what}: {name} is {_short(state.get(name))}, now {_short(value)}"
            )
    return like.restored(state)


def fingerprint(model: InverseModel) -> str:
    """A short digest of what a model answers: equal for models equal to the last bit."""
    sha = hashlib.blake2b(digest_size=8)
    for name, value in sorted(model.state_dict().items()):
        # A model that has not changed says so by staying as it was, of whatever sample it was told.
        if name in ("seq", "valid", "noise_variance"):
            continue
        sha.update(name.encode())
        sha.update(value.tobytes() if isinstance(value, np.ndarray) else json.dumps(value).encode())
    return sha.hexdigest()


def _roles(state: StateDict) -> list[str]:
    return [name.split(".")[1] for name in state if name.startswith("model.") and name.endswith(".kind")
            and name.count(".") == 2]  # fmt: skip


def _model(state: StateDict, role: str) -> InverseModel:
    kind = str(state["kind"])
    return build_model(kind, state, f"the {role} model")


def _served(axis: Axis, state: StateDict, learner: OnlineModel | None, watched: dict[str, InverseModel]) -> Served:
    now = axis.newest
    models = dict(now.models)
    if learner is not None:
        models[axis.config.learn] = watched["good"] if "good" in watched else learner.snapshot()
        models |= champion_of(learner)
    memories: dict[str, FloatArray] = {}
    for name, model in models.items():
        memory = np.array(state.get(f"memory.{name}", model.rest_memory(0.0)), dtype=np.float64)
        if memory.shape != (model.memory_size,) or not np.isfinite(memory).all():
            raise FieldError(f"memory.{name}", memory.shape, f"({model.memory_size},) finite numbers")
        memories[name] = memory
    default = str(state["served.default"])
    return replace(
        now, seq=int(state["served.seq"]), t_s=float(state["served.t_s"]), u_V=float(state["served.u_V"]),
        models=models, memories=memories, default=default if default in models else now.default,
        trust=float(state["served.trust"]), trouble=str(state["served.trouble"]),
    )  # fmt: skip


def _same(a: Any, b: Any) -> bool:
    # What is not finite went through the file as an array, a tuple as a list.
    if isinstance(a, np.ndarray | float) or isinstance(b, np.ndarray | float):
        return np.shape(a) == np.shape(b) and bool(np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True))
    return bool(a == b or (isinstance(a, tuple) and list(a) == b))


def _short(value: Any) -> str:
    text = f"an array {value.shape}" if isinstance(value, np.ndarray) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
