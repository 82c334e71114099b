"""Stage configurations as dictionaries and as TOML or JSON files, schema 1.

A file is checked key by key. Unknown keys, wrong types and values out of range raise InputError with the key, what was
found and what was expected; another schema raises ModelFileError.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.sim.effects import Chain, effect
from dehyst.sim.stage.config import ParameterChange, StageConfig

SCHEMA = 1
_KEYS = ("schema", "name", "dt_s", "seed", "u_min_V", "u_max_V", "effects", "second_axis", "changes")


def to_dict(config: StageConfig) -> dict[str, Any]:
    """The configuration as JSON values; `from_dict` makes an equal one from it."""
    result: dict[str, Any] = {
        "schema": SCHEMA,
        "name": config.name,
        "dt_s": config.dt_s,
        "seed": config.seed,
        "u_min_V": config.u_min_V,
        "u_max_V": config.u_max_V,
        "effects": _effects(config.effects),
    }
    if config.second_axis is not None:
        result["second_axis"] = _effects(config.second_axis)
    if config.changes:
        result["changes"] = [{"t_s": t_s, "set": dict(values)} for t_s, values in config.changes]
    return result


def _effects(chain: Chain) -> list[dict[str, Any]]:
    rows = []
    for e in chain:
        label = {"label": e.label} if e.label != e.name else {}
        rows.append({"effect": e.name, **label, **e.values})
    return rows


def from_dict(data: Any) -> StageConfig:
    """The configuration in a dictionary. Raises InputError and ModelFileError as the module says."""
    table = _table(data, "stage")
    if table.get("schema") != SCHEMA:
        raise ModelFileError(f"schema: got {table.get('schema')!r}, expected {SCHEMA}; write the stage file again")
    _only(table, _KEYS, "stage")
    if "effects" not in table:
        raise InputError("effects: missing, expected a list of effects")
    known: dict[str, Any] = {}
    for key in ("dt_s", "u_min_V", "u_max_V"):
        if key in table:
            known[key] = _number(table[key], key)
    if "seed" in table:
        known["seed"] = table["seed"]
    name = table.get("name", "stage")
    if not isinstance(name, str):
        raise InputError(f"name: got {name!r}, expected a text")
    return StageConfig(
        name=name,
        effects=_chain(table["effects"], "effects"),
        second_axis=_chain(table["second_axis"], "second_axis") if "second_axis" in table else None,
        changes=tuple(_change(row, i) for i, row in enumerate(_list(table.get("changes", []), "changes"))),
        **known,
    )


def _chain(rows: Any, where: str) -> Chain:
    effects = []
    for i, row in enumerate(_list(rows, where)):
        table = dict(_table(row, f"{where}[{i}]"))
        name, label = table.pop("effect", None), table.pop("label", "")
        if not isinstance(name, str) or not isinstance(label, str) or "." in label or "/" in label:
            raise InputError(
                f"{where}[{i}]: got effect {name!r}, label {label!r}, expected the name of an effect in 'effect' "
                "and optionally a text without '.' and '/' in 'label'"
            )
        try:
            effects.append(effect(name, label=label, **table))
        except InputError as error:
            raise InputError(f"{where}[{i}]: {error}") from None
    return Chain(tuple(effects))


def _change(row: Any, i: int) -> ParameterChange:
    table = _table(row, f"changes[{i}]")
    _only(table, ("t_s", "set"), f"changes[{i}]")
    values = _table(table.get("set"), f"changes[{i}].set")
    return _number(table.get("t_s"), f"changes[{i}].t_s"), {
        k: _number(v, f"changes[{i}].{k}") for k, v in values.items()
    }


def _table(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{where}: got {value!r:.60}, expected a table of named values")
    return value


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise InputError(f"{where}: got {value!r:.60}, expected a list")
    return list(value)


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: got {value!r:.60}, expected a number")
    return float(value)


def _only(table: Mapping[str, Any], keys: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in keys:
            raise InputError(
                f"{where}: got unknown key {key!r}, expected some of: {', '.join(keys)}; remove or rename it"
            )


def load_stage(path: str | Path) -> StageConfig:
    """Read a stage file, ``.toml`` or ``.json``. Raises InputError naming the file and what is wrong in it."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}), expected a stage file, .toml or .json") from None
    try:
        if path.suffix == ".toml":
            data: Any = tomllib.loads(text)
        elif path.suffix == ".json":
            data = json.loads(text)
        else:
            raise InputError(f"got suffix {path.suffix!r}, expected .toml or .json; rename the file")
        return from_dict(data)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: is not valid {path.suffix[1:].upper()}: {error}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from None


def save_stage(config: StageConfig, path: str | Path) -> None:
    """Write a stage file, ``.toml`` or ``.json``, from which `load_stage` reads an equal configuration."""
    path = Path(path)
    if path.suffix == ".toml":
        text = to_toml(config)
    elif path.suffix == ".json":
        text = json.dumps(to_dict(config), indent=1) + "\n"
    else:
        raise InputError(f"{path}: got suffix {path.suffix!r}, expected .toml or .json")
    path.write_text(text, encoding="utf-8")


def to_toml(config: StageConfig) -> str:
    """The configuration as TOML, one table per effect, with unit and meaning of each parameter as a comment."""
    data = to_dict(config)
    lines = [f"{key} = {_scalar(data[key])}" for key in _KEYS[:6]]
    for key, chain in (("effects", config.effects), ("second_axis", config.second_axis)):
        for e in chain or ():
            lines += ["", f"[[{key}]]", f"effect = {_scalar(e.name)}"]
            if e.label != e.name:
                lines.append(f"label = {_scalar(e.label)}")
            lines += [
                f"{p.name} = {_scalar(value)}  # {p.unit}: {p.meaning}"
                for p, value in zip(e.kind.parameters, e.numbers, strict=True)
            ]
    for t_s, values in config.changes:
        lines += ["", "[[changes]]", f"t_s = {_scalar(float(t_s))}", "[changes.set]"]
        lines += [f"{_scalar(path)} = {_scalar(float(value))}" for path, value in values.items()]
    return "\n".join(lines) + "\n"


def _scalar(value: str | float | int) -> str:
    """A TOML scalar; TOML's basic strings and numbers are JSON's."""
    return json.dumps(value, ensure_ascii=True)
