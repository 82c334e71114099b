"""The model file: the models of one axis by name in one ``.npz`` archive (docs/protocol.md describes its form).

It holds arrays and one JSON header, and no code. A file that is damaged, foreign or of another version is refused.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.npy_sizes import check_npz
from dehyst.adaptive.types import InverseModel, StateDict
from dehyst.service.protocol.container import MAX_HEADER_BYTES, UNITS, decode_header, encode_header, split_state
from dehyst.service.protocol.model import build_model, stored_kind
from dehyst.service.storage.output import atomic_write

SCHEMA: Final = 1
#: Identifies a model file among other .npz files.
MAGIC: Final = "dehyst model bundle"
#: Largest magnitude of an end of a range, µm or V.
_MOST_RANGE: Final = 1e12
#: Most bytes of the arrays of a file; one of this program has some hundred kB.
MAX_BYTES: Final = 128 * 2**20


@dataclass(frozen=True, slots=True)
class BundleMeta:
    """The axis and the recording that the models of a file belong to.

    Attributes
    ----------
    stage, axis : names on the wire.
    dt_s : sample time of all models, s.
    source, source_sha256 : name of the recording that the models were identified from, and its hash (hexadecimal);
        empty without a recording.
    y_min_um, y_max_um : displacement range of that recording, µm; None if unknown.
    u_min_V, u_max_V : voltage range of that recording, V; None if unknown.
    notes : further figures, such as held-out errors; JSON scalars.
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
    """The content of a model file: the models by name, and the axis and recording that they belong to."""

    models: dict[str, InverseModel]
    meta: BundleMeta


def write_bundle(path: Path | str, models: Mapping[str, InverseModel], meta: BundleMeta) -> None:
    """Write ``models`` by name into ``path``, atomically.

    Raises ModelFileError if a model is of an unknown class or of another sample time than ``meta``, or if a state or
    the notes have no JSON form; OSError as the disk does.
    """
    path = Path(path)
    entries: dict[str, NDArray[Any]] = {}
    listed: dict[str, Any] = {}
    for name, model in models.items():
        if model.dt_s != meta.dt_s:
            raise ModelFileError(f"model {name!r}: dt_s is {model.dt_s}, but that of the bundle is {meta.dt_s}")
        values, arrays = split_state(model.state_dict())
        listed[name] = {"kind": stored_kind(model), "values": values, "arrays": sorted(arrays)}
        entries.update({f"{name}/{key}": array for key, array in arrays.items()})
    header = {"magic": MAGIC, "schema": SCHEMA, "units": UNITS, **asdict(meta), "models": listed}
    entries["header"] = np.frombuffer(encode_header(header), dtype=np.uint8)
    with atomic_write(path) as file:
        # Not compressed: a file has some hundred kB and is read at every start of a service.
        np.savez(file, allow_pickle=False, **entries)


def read_bundle(path: Path | str) -> Bundle:
    """Read a model file. Raises ModelFileError with what is wrong with the file and what to do."""
    path = Path(path)
    try:
        with path.open("rb") as raw, zipfile.ZipFile(raw) as archive:
            check_npz(archive, MAX_BYTES)
            # Not np.load, which would read a file that begins as an array as one, of any size.
            with np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
                header = _header(path, file)
                models = {name: _model(path, file, name, entry) for name, entry in header["models"].items()}
    except FileNotFoundError:
        raise ModelFileError(f"{path}: no such file; make one with 'dehyst identify DATA --out {path}'") from None
    except OSError as error:
        raise ModelFileError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ModelFileError:
        raise
    except Exception as error:  # zipfile, its decompressors and numpy raise many kinds of errors on a damaged file
        what = str(error)[:300]
        raise ModelFileError(f"{path}: damaged, or not a model bundle ({what}); identify the stage again") from error
    meta = _meta(path, header)
    for name, model in models.items():
        if model.dt_s != meta.dt_s:
            raise ModelFileError(f"{path}: model {name!r} has dt_s {model.dt_s}, its bundle {meta.dt_s}")
    return Bundle(models, meta)


def _header(path: Path, file: Any) -> dict[str, Any]:
    if "header" not in file.files:
        raise ModelFileError(f"{path}: not a model bundle: it has no header; make one with 'dehyst identify'")
    raw = file["header"]
    if raw.dtype != np.uint8 or raw.ndim != 1 or raw.size > MAX_HEADER_BYTES:
        raise ModelFileError(
            f"{path}: not a model bundle: its header is not a text of at most {MAX_HEADER_BYTES} bytes"
        )
    try:
        header = decode_header(raw.tobytes())
    except InputError as error:
        raise ModelFileError(f"{path}: {error}; identify the stage again") from error
    if header.get("magic") != MAGIC:
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
    for name in ("stage", "axis", "source", "source_sha256"):
        if not isinstance(known.get(name, ""), str):
            raise ModelFileError(f"{path}: {name} is {str(known[name])[:40]!r}, expected a text")
    if not isinstance(known.get("notes", {}), dict):
        raise ModelFileError(f"{path}: notes are {str(known['notes'])[:40]!r}, expected an object of figures")
    for name in ("y_min_um", "y_max_um", "u_min_V", "u_max_V"):
        value = known.get(name)
        if value is not None and (not isinstance(value, float | int) or not abs(value) < _MOST_RANGE):
            raise ModelFileError(f"{path}: {name} is {str(value)[:40]!r}, expected a number")
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
    return build_model(kind, state, where)
