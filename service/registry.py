"""Which class a stored model is built by: kind → import path, imported only when such a model is met."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, cast

from adaptive.errors import ModelFileError
from adaptive.types import InverseModel, StateDict

#: kind in files and on the wire → "module:Class" with a ``from_state(StateDict)`` that builds an equal model.
KINDS: dict[str, str] = {
    "lssvm": "adaptive.snapshot:LssvmInverse",
    "linear": "baselines.linear:LinearInverse",
    "bouc_wen": "baselines.bouc_wen_inverse:BoucWenInverse",
    "mpi": "baselines.mpi_inverse:MpiInverse",
    "champion": "baselines.champion:ChampionInverse",
}


def register(kind: str, path: str) -> None:
    """Make ``kind`` known as ``path`` ("module:Class"), for models that come from outside this project."""
    KINDS[kind] = path


def kind_of(model: InverseModel) -> str:
    """The kind under which ``model`` is stored. Raises ModelFileError where its class is not registered."""
    path = f"{type(model).__module__}:{type(model).__qualname__}"
    for kind, known in KINDS.items():
        if known == path:
            return kind
    raise ModelFileError(
        f"model {model.name!r}: {path} is not a registered kind (known: {', '.join(sorted(KINDS))}); "
        "register it with service.registry.register before storing it"
    )


def build(kind: str, state: StateDict, where: str) -> InverseModel:
    """The model of ``kind`` with ``state``. Raises ModelFileError, beginning with ``where``, if it cannot be built."""
    if kind not in KINDS:
        raise ModelFileError(f"{where}: kind {kind!r} is not known (known: {', '.join(sorted(KINDS))})")
    module, _, name = KINDS[kind].partition(":")
    try:
        from_state = cast(Callable[[StateDict], Any], getattr(importlib.import_module(module), name).from_state)
        model = from_state(state)
    except (ImportError, AttributeError) as error:
        raise ModelFileError(f"{where}: kind {kind!r} cannot be loaded: {error}") from error
    except (LookupError, ValueError, TypeError, ArithmeticError) as error:
        raise ModelFileError(f"{where}: the stored state is not that of a {kind!r} model: {error!r}") from error
    if not isinstance(model, InverseModel):
        raise ModelFileError(f"{where}: {KINDS[kind]} does not build an inverse model")
    return model
