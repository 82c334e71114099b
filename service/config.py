"""Configuration of ``dehyst serve``: one TOML file, read strictly. A key that is not known is refused, not ignored."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from service.errors import FieldError
from service.guard import Limits
from service.keys import check_name
from service.session import DEFAULT_ENDPOINT, check_endpoint, is_loopback

EXAMPLE = f"""\
# Configuration of 'dehyst serve --config FILE'. Displacement in µm, voltage in V, time in s.

stage = "demo"                      # name of the stage on the wire: a-z, 0-9, _ and -
listen = ["{DEFAULT_ENDPOINT}"]   # where controllers, stage and viewer connect
# connect = []                      # routers or other services to connect to
# beyond_loopback = false           # true: allow 'listen' to be reached from other machines
# zenoh_config = "secure.json5"     # zenoh's own configuration: TLS, passwords, access control

[[axis]]                            # one such table an axis
name = "x"                          # name of the axis on the wire
model = "x.npz"                     # from 'dehyst identify'; relative to this file
u_min_V = 0.0                       # limits of what leaves; there are no defaults for these three
u_max_V = 10.0
slew_V_per_s = 2000.0
# y_min_um = -5.0                   # a trajectory beyond is refused; default: 5 % beyond the identified range
# y_max_um = 95.0
# served = "lssvm_adaptive"         # the model that answers where a query names none
# learn = "lssvm_adaptive"          # the model that learns; "" for none
# snapshot_every = 20               # samples between two snapshots that queries read
# snapshots_kept = 256              # how many of them a query can reach with as_of
# queue_samples = 20000             # samples that may wait for the learner; what comes on top is counted and lost
# model_hz = 50.0                   # how often the model is published, at most, 1/s
# recorder = "recordings/x"         # folder for recordings of the samples; relative to this file

# [axis.learner]                    # settings of the learner, see docs/learner.md
"""


@dataclass(frozen=True, slots=True)
class AxisConfig:
    """One axis of a service; the fields are those of the example. ``limits.y_*`` are infinite where not given."""

    name: str
    model: Path
    limits: Limits
    served: str = "lssvm_adaptive"
    learn: str = "lssvm_adaptive"
    snapshot_every: int = 20
    snapshots_kept: int = 256
    queue_samples: int = 20_000
    model_hz: float = 50.0
    recorder: Path | None = None
    learner: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ServeConfig:
    """A whole service: one stage, one or more axes."""

    stage: str
    axes: tuple[AxisConfig, ...]
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    connect: tuple[str, ...] = ()
    zenoh_config: Path | None = None


def read_config(path: Path | str) -> ServeConfig:
    """Read a configuration file. Raises InputError naming the file, the key, what was got and what was expected."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FieldError(
            str(path), str(error), "a readable TOML file", "'dehyst serve --example' prints one to begin with"
        ) from error
    return parse_config(text, str(path), path.parent)


def parse_config(text: str, where: str, folder: Path) -> ServeConfig:
    """The configuration in ``text``; paths in it are relative to ``folder``, ``where`` begins every message."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FieldError(where, f"no TOML ({error})", "a TOML file", "mend the line named") from error
    table = _Table(data, where)
    stage = check_name(f"{where}: stage", table.take("stage", str))
    listen = tuple(_endpoints(table, "listen", [DEFAULT_ENDPOINT]))
    connect = tuple(_endpoints(table, "connect", []))
    zenoh_config = table.path("zenoh_config", folder)
    if not table.take("beyond_loopback", bool, False):
        for endpoint in listen:
            if not is_loopback(endpoint):
                raise FieldError(
                    f"{where}: listen",
                    endpoint,
                    "an endpoint of this machine only",
                    "set beyond_loopback = true if others are to reach the service, and secure it by zenoh_config",
                )
    if not listen and not connect:
        raise FieldError(f"{where}: listen", "nothing", "an endpoint to listen at, or one to connect to")
    tables = table.take("axis", list)
    table.done()
    axes = tuple(_axis(entry, f"{where}: axis[{i}]", folder) for i, entry in enumerate(tables))
    if not axes:
        raise FieldError(f"{where}: axis", "none", "one or more [[axis]] tables")
    names = [axis.name for axis in axes]
    if len(set(names)) < len(names):
        raise FieldError(f"{where}: axis", ", ".join(names), "a different name for each axis")
    return ServeConfig(stage, axes, listen, connect, zenoh_config)


def _axis(entry: Any, where: str, folder: Path) -> AxisConfig:
    if not isinstance(entry, dict):
        raise FieldError(where, repr(entry), "a [[axis]] table")
    table = _Table(entry, where)
    name = check_name(f"{where}.name", table.take("name", str))
    model = table.path("model", folder)
    if model is None:
        raise FieldError(f"{where}.model", "nothing", "a model file", "make one with 'dehyst identify'")
    try:
        limits = Limits(
            table.take("u_min_V", float),
            table.take("u_max_V", float),
            table.take("slew_V_per_s", float),
            table.take("y_min_um", float, -math.inf),
            table.take("y_max_um", float, math.inf),
        )
    except FieldError as error:
        if error.field.startswith(where):
            raise
        raise FieldError(f"{where}.{error.field}", error.got, error.expected) from error
    axis = AxisConfig(
        name,
        model,
        limits,
        served=table.take("served", str, "lssvm_adaptive"),
        learn=table.take("learn", str, "lssvm_adaptive"),
        snapshot_every=table.within("snapshot_every", 20, 1, 100_000),
        snapshots_kept=table.within("snapshots_kept", 256, 1, 4096),
        queue_samples=table.within("queue_samples", 20_000, 1, 10_000_000),
        model_hz=table.take("model_hz", float, 50.0, lambda value: 0 < value <= 1000, "0 to 1000 1/s"),
        recorder=table.path("recorder", folder),
        learner=table.take("learner", dict, {}),
    )
    table.done()
    return axis


class _Table:
    """A table of which every key must be taken; what is left at the end is not known."""

    def __init__(self, data: dict[str, Any], where: str) -> None:
        self._data = dict(data)
        self._known: list[str] = []
        self._where = where

    def take(
        self,
        key: str,
        kind: type,
        default: Any = None,
        valid: Callable[[Any], bool] = lambda _: True,
        expected: str = "",
    ) -> Any:
        self._known.append(key)
        names = {
            str: "a text",
            float: "a number",
            bool: "true or false",
            list: "a list",
            dict: "a table",
            int: "an integer",
        }
        expected = expected or names[kind]
        if key not in self._data:
            if default is None:
                raise FieldError(f"{self._where}: {key}", "nothing", expected, "this key must be given")
            return default
        value = self._data.pop(key)
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)) or not valid(value):
            raise FieldError(f"{self._where}: {key}", repr(value), expected)
        if isinstance(value, float) and math.isnan(value):
            raise FieldError(f"{self._where}: {key}", "nan", expected)
        return value

    def within(self, key: str, default: int, least: int, most: int) -> int:
        return int(self.take(key, int, default, lambda v: least <= v <= most, f"an integer from {least} to {most}"))

    def path(self, key: str, folder: Path) -> Path | None:
        value = self.take(key, str, "")
        return folder / value if value else None

    def done(self) -> None:
        for key, value in self._data.items():
            raise FieldError(
                f"{self._where}: {key}", repr(value)[:80], f"one of the known keys: {', '.join(sorted(self._known))}"
            )


def _endpoints(table: _Table, key: str, default: list[str]) -> list[str]:
    return [check_endpoint(key, endpoint) for endpoint in table.take(key, list, default)]
