"""Model classes by the kind under which files and messages store them."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final, cast

from adaptive.errors import ModelFileError
from adaptive.types import InverseModel, StateDict

#: Kind in files and messages -> "module:class". The class has a ``from_state(StateDict)`` that builds an equal model.
#: A module is imported when the first model of its kind is built: a client loads the models that it uses, no others.
MODEL_CLASSES: Final = {
    "lssvm": "adaptive.inverse_model:LssvmInverse",
    "linear": "baselines.linear:LinearInverse",
    "bouc_wen": "baselines.bouc_wen.model:BoucWenInverse",
    "mpi": "baselines.prandtl_ishlinskii.model:MpiInverse",
    "champion": "baselines.competition.champion:ChampionInverse",
}


def stored_kind(model: InverseModel) -> str:
    """The kind under which ``model`` is stored. Raises ModelFileError if its class is not in `MODEL_CLASSES`."""
    path = f"{type(model).__module__}:{type(model).__qualname__}"
    for kind, known in MODEL_CLASSES.items():
        if known == path:
            return kind
    raise ModelFileError(
        f"model {model.name!r}: got the class {path}, expected a registered one: {', '.join(MODEL_CLASSES.values())}"
    )


def build_model(kind: str, state: StateDict, where: str) -> InverseModel:
    """The model of ``kind`` with ``state``. Raises ModelFileError, beginning with ``where``, if it cannot be built."""
    if kind not in MODEL_CLASSES:
        raise ModelFileError(f"{where}: got the kind {kind!r}, expected one of {', '.join(sorted(MODEL_CLASSES))}")
    module, _, name = MODEL_CLASSES[kind].partition(":")
    try:
        from_state = cast(Callable[[StateDict], Any], getattr(importlib.import_module(module), name).from_state)
        model = from_state(state)
    except (ImportError, AttributeError) as error:
        raise ModelFileError(f"{where}: kind {kind!r} cannot be loaded: {error}") from error
    except ModelFileError as error:
        raise ModelFileError(f"{where}: {error}") from error
    except (LookupError, ValueError, TypeError, ArithmeticError) as error:
        raise ModelFileError(f"{where}: the stored state is not that of a {kind!r} model: {error!r}") from error
    if not isinstance(model, InverseModel):
        raise ModelFileError(f"{where}: {MODEL_CLASSES[kind]} does not build an inverse model")
    return model
