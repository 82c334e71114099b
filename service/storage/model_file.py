"""The model bundle: one ``.npz`` file with the models of one axis by name; docs/protocol.md tells its form.

Nothing in it is code: arrays, and one JSON header. A file that is damaged, foreign or of another version is refused.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import ModelFileError
from adaptive.types import InverseModel, StateDict

# --- Which class a stored model is built by: kind → import path, imported only when such a model is met.


#: kind in files and on the wire → "module:Class" with a ``from_state(StateDict)`` that builds an equal model.
KINDS: dict[str, str] = {
    "lssvm": "adaptive.inverse_model:LssvmInverse",
    "linear": "baselines.linear:LinearInverse",
    "bouc_wen": "baselines.bouc_wen.inverse:BoucWenInverse",
    "mpi": "baselines.prandtl_ishlinskii.inverse:MpiInverse",
    "champion": "baselines.competition.champion:ChampionInverse",
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
        "register it with service.storage.model_file.register before storing it"
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


SCHEMA: Final = 1
#: Tells a bundle from any other .npz file.
MAGIC: Final = "dehyst model bundle"
UNITS: Final = {"y": "um", "u": "V", "t": "s", "v": "um/s", "a": "um/s2"}
#: Longest header that is read, so that a foreign file cannot ask for all of the memory.
_MAX_HEADER_BYTES: Final = 4 * 2**20


@dataclass(frozen=True, slots=True)
class BundleMeta:
    """What a bundle belongs to.

    Attributes
    ----------
    stage, axis : names on the wire.
    dt_s : sample time of all its models, s.
    source : name of the recording it was identified from, and
    source_sha256 : that recording's hash, hexadecimal; empty where there was none.
    y_min_um, y_max_um : displacement range of that recording, µm.
    u_min_V, u_max_V : voltage range of that recording, V.
    notes : figures worth keeping, such as held-out errors; JSON scalars.
    """

    stage: str
    axis: str
    dt_s: float
    source: str = ""
    source_sha256: str = ""
    y_min_um: float | None = None
    y_max_um: float | None = None
    u_min_V: float | None = None
    u_max_V: float | None = None
    notes: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle as read: its models by name, and what they belong to."""

    models: dict[str, InverseModel]
    meta: BundleMeta


def split_state(state: StateDict) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """(JSON values, arrays) of a state; numpy scalars become JSON numbers, what is not finite an array ()."""
    values: dict[str, Any] = {}
    arrays: dict[str, NDArray[Any]] = {}
    for key, value in state.items():
        if isinstance(value, np.ndarray):
            if value.dtype.kind not in "fiub":
                raise ModelFileError(f"state {key!r}: arrays of {value.dtype} cannot be stored, only numbers")
            arrays[key] = value
            continue
        plain = value.item() if isinstance(value, np.generic) else value
        if isinstance(plain, float) and not math.isfinite(plain):
            # JSON has neither NaN nor infinity; an array of no dimensions does.
            arrays[key] = np.array(plain)
        else:
            values[key] = plain
    return values, arrays


def write_bundle(path: Path | str, models: Mapping[str, InverseModel], meta: BundleMeta) -> None:
    """Write ``models`` by name into ``path``, whole or not at all: a reader never meets half a file.

    Raises ModelFileError where a model is of an unknown kind or another sample time, OSError from the disk.
    """
    path = Path(path)
    entries: dict[str, NDArray[Any]] = {}
    listed: dict[str, Any] = {}
    for name, model in models.items():
        if model.dt_s != meta.dt_s:
            raise ModelFileError(f"model {name!r}: dt_s is {model.dt_s}, but that of the bundle is {meta.dt_s}")
        values, arrays = split_state(model.state_dict())
        listed[name] = {"kind": kind_of(model), "values": values, "arrays": sorted(arrays)}
        entries.update({f"{name}/{key}": array for key, array in arrays.items()})
    header = {"magic": MAGIC, "schema": SCHEMA, "units": UNITS, **asdict(meta), "models": listed}
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ModelFileError(f"{path}: a model's state or the notes hold what JSON cannot: {error}") from error
    entries["header"] = np.frombuffer(text.encode(), dtype=np.uint8)
    handle, part = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            # Without compression: a file is some hundred kB, and is read at every start of a service.
            np.savez(file, allow_pickle=False, **entries)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


def read_bundle(path: Path | str) -> Bundle:
    """Read a bundle. Raises ModelFileError saying what is wrong with the file and what to do."""
    path = Path(path)
    try:
        # Opened here, because numpy leaves the file open where it is no archive.
        with path.open("rb") as raw:
            loaded = np.load(raw, allow_pickle=False)
            if not isinstance(loaded, np.lib.npyio.NpzFile):
                raise ModelFileError(f"{path}: not a model bundle but a single array; make one with 'dehyst identify'")
            with loaded as file:
                header = _header(path, file)
                models = {name: _model(path, file, name, entry) for name, entry in header["models"].items()}
    except FileNotFoundError:
        raise ModelFileError(
            f"{path}: there is no such file; make one with 'dehyst identify DATA --out {path}'"
        ) from None
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (zipfile.BadZipFile, ValueError, EOFError) as error:
        raise ModelFileError(f"{path}: damaged, or not a model bundle ({error}); identify the stage again") from error
    meta = _meta(path, header)
    for name, model in models.items():
        if model.dt_s != meta.dt_s:
            raise ModelFileError(f"{path}: model {name!r} has dt_s {model.dt_s}, its bundle {meta.dt_s}")
    return Bundle(models, meta)


def _header(path: Path, file: Any) -> dict[str, Any]:
    if "header" not in file.files:
        raise ModelFileError(f"{path}: not a model bundle: it has no header; make one with 'dehyst identify'")
    raw = file["header"]
    if raw.dtype != np.uint8 or raw.ndim != 1 or raw.size > _MAX_HEADER_BYTES:
        raise ModelFileError(
            f"{path}: not a model bundle: its header is not a text of at most {_MAX_HEADER_BYTES} bytes"
        )
    try:
        header = json.loads(raw.tobytes())
    except ValueError as error:
        raise ModelFileError(f"{path}: its header is not JSON ({error}); identify the stage again") from error
    if not isinstance(header, dict) or header.get("magic") != MAGIC:
        raise ModelFileError(f"{path}: not a model bundle: it does not say {MAGIC!r}")
    if header.get("schema") != SCHEMA:
        raise ModelFileError(
            f"{path}: schema is {header.get('schema')!r}, this program reads {SCHEMA}; "
            "use the version of dehyst that wrote it, or identify the stage again"
        )
    if header.get("units") != UNITS:
        raise ModelFileError(f"{path}: units are {header.get('units')!r}, expected {UNITS}")
    if not isinstance(header.get("models"), dict) or not header["models"]:
        raise ModelFileError(f"{path}: the bundle holds no models; identify the stage again")
    return header


def _meta(path: Path, header: dict[str, Any]) -> BundleMeta:
    known = {name: header[name] for name in BundleMeta.__dataclass_fields__ if name in header}
    dt_s = known.get("dt_s")
    if not isinstance(dt_s, float | int) or not 0 < dt_s < 3600:
        raise ModelFileError(f"{path}: dt_s is {dt_s!r}, expected a sample time in s")
    try:
        return BundleMeta(**known)
    except TypeError as error:
        raise ModelFileError(f"{path}: its header lacks a field: {error}") from error


def _model(path: Path, file: Any, name: str, entry: Any) -> InverseModel:
    where = f"{path}: model {name!r}"
    try:
        kind, values, arrays = str(entry["kind"]), dict(entry["values"]), list(entry["arrays"])
        state: StateDict = values | {key: file[f"{name}/{key}"] for key in arrays}
    except (KeyError, TypeError) as error:
        raise ModelFileError(f"{where}: its entry is incomplete: {error!r}; identify the stage again") from error
    return build(kind, state, where)
