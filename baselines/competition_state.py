"""The whole state of a competition as flat entries, and back: it goes on from them to the same last bit."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from adaptive.errors import InputError, ModelFileError
from adaptive.state import prefixed, under
from adaptive.types import OnlineModel, StateDict
from baselines.champion import ChampionInverse
from baselines.contest_config import CompetitionConfig
from baselines.contestants import KINDS, Revive, fingerprint

if TYPE_CHECKING:
    from baselines.competition import Competition


def to_state(c: Competition) -> StateDict:
    """All of ``c``; copies. Raises InputError where a contestant is of no kind that can be read back."""
    kinds = {known: kind for kind, known in KINDS.items()}
    if any(type(model) not in kinds for model in c._models):
        raise InputError(f"contestants: expected models of the kinds {', '.join(KINDS)} to be stored")
    state: StateDict = {
        "names": ",".join(c.names),
        "kinds": ",".join(kinds[type(model)] for model in c._models),
        "range_um": c._range_um,
        "span_V": c._span_V,
        "seq": c._seq,
        "frozen": c._frozen,
        "failed_seq": c._failed_seq,
        "ahead_s": c._succession.ahead_s,
        "changes": c._succession.changes,
        "out": np.array(c._out, dtype=np.bool_),
        "past_seq": np.array([seq for seq, _ in c._judging.past], dtype=np.int64),
    }
    state |= prefixed("config.", c.config.state_dict())
    state |= prefixed("motion.", c._motion.state_dict())
    # Without names and champion of their own: only the models are wanted.
    snapshots = {"start": c._judging.start, "newest": c._newest} | {
        f"past{k}": kept for k, (_, kept) in enumerate(c._judging.past)
    }
    for where, models in snapshots.items():
        state |= prefixed(f"{where}.", ChampionInverse(c.names, models, 0).state_dict())
    state["champion"] = c._succession.champion
    for name, model, score in zip(c.names, c._models, c._judging.scores, strict=True):
        # What it began from, so that the state of another identification can be told.
        state[f"base.{name}"] = fingerprint(getattr(model, "base", None))
        state |= {f"score.{name}.memory": score.memory.copy(), f"score.{name}.square_V2": score.square_V2}
        state[f"score.{name}.weight"] = score.weight
        state |= prefixed(f"model.{name}.", model.state_dict())
    return state


def contestants_of(state: StateDict) -> dict[str, OnlineModel]:
    """The contestants of a state, by name. Raises KeyError, ValueError or TypeError where it is none."""
    names, kinds = str(state["names"]).split(","), str(state["kinds"]).split(",")
    return {
        name: KINDS[kind].from_state(under(f"model.{name}.", state)) for name, kind in zip(names, kinds, strict=True)
    }


def made_of(kind: type[Competition], state: StateDict, revive: Revive | None) -> Competition:
    """A competition that goes on from a state. Raises ModelFileError where entries are missing or do not fit."""
    try:
        config = CompetitionConfig(**under("config.", state))
        made = kind(contestants_of(state), float(state["range_um"]), float(state["span_V"]), config, revive)
        restore(made, state)
    except (KeyError, TypeError, ValueError) as error:
        raise ModelFileError(f"competition state: entry missing or damaged: {error}; start from models") from error
    return made


def restore(c: Competition, state: StateDict) -> None:
    """Let ``c``, made of the state's contestants, go on from it. Raises KeyError, ValueError or TypeError."""
    c._motion.restore(under("motion.", state))
    c._judging.start = ChampionInverse.from_state(under("start.", state)).models
    c._newest = ChampionInverse.from_state(under("newest.", state)).models
    c._succession.champion, c._succession.changes = int(state["champion"]), int(state["changes"])
    c._succession.ahead_s = float(state["ahead_s"])
    c._judging.past.clear()
    for k, seq in enumerate(np.asarray(state["past_seq"]).tolist()):
        c._judging.remember(int(seq), ChampionInverse.from_state(under(f"past{k}.", state)).models)
    for name, score in zip(c.names, c._judging.scores, strict=True):
        kept = under(f"score.{name}.", state)
        score.memory = np.array(kept["memory"], dtype=np.float64)
        score.square_V2, score.weight = float(kept["square_V2"]), float(kept["weight"])
    c._serving = c._served()
    c._out = [bool(out) for out in np.asarray(state["out"]).tolist()]
    c._frozen, c._failed_seq = bool(state["frozen"]), int(state["failed_seq"])
    c._seq = int(state["seq"])
