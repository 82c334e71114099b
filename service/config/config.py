"""Configuration of ``dehyst serve``: one TOML file, read strictly. A key that is not known is refused, not ignored."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from baselines.competition.config import CompetitionConfig
from service.answers.guard import Limits
from service.background.diagnosing.settings import WatchConfig
from service.background.retuning.settings import RetuningConfig
from service.config.tables import Table, build_settings
from service.protocol.errors import FieldError
from service.protocol.keys import AUTO, check_name
from service.runtime.session import DEFAULT_ENDPOINT, check_endpoint
from service.security.check import check_reach

#: The model that learns.
LEARN = "lssvm_adaptive"
#: Models that compete with the one that learns, where the model file has them.
COMPETE = ("linear", "mpi", "bouc_wen")

EXAMPLE = f"""\
# Configuration of 'dehyst serve --config FILE'. Displacement in µm, voltage in V, time in s.

stage = "demo"                      # name of the stage on the wire: a-z, 0-9, _ and -
listen = ["{DEFAULT_ENDPOINT}"]   # where controllers, stage and viewer connect
# connect = []                      # routers or other services to connect to
# standby_listen = []               # where 'dehyst serve --standby' listens; clients look for it there
# lease_s = 1.0                     # a service that is silent for so long is taken for dead, s
# zenoh_config = "service.json5"    # TLS, passwords, access control, from 'dehyst access init'; for other machines
# insecure_beyond_loopback = false  # true: be reached from other machines without them, by everybody there

[[axis]]                            # one such table an axis
name = "x"                          # name of the axis on the wire
model = "x.npz"                     # from 'dehyst identify'; relative to this file
u_min_V = 0.0                       # limits of what leaves; there are no defaults for these three
u_max_V = 10.0
slew_V_per_s = 2000.0
# y_min_um = -5.0                   # a trajectory beyond is refused; default: 5 % beyond the identified range
# y_max_um = 95.0
# served = "{AUTO}"                   # the model that answers where a query names none; "auto": the best that learns
# learn = "lssvm_adaptive"          # the model that learns; "" for none
# compete = ["linear", "mpi", "bouc_wen"]   # models that learn beside it; the best answers as "auto"; [] for none
# snapshot_every = 20               # samples between two snapshots that queries read
# snapshots_kept = 256              # how many of them a query can reach with as_of
# queue_samples = 20000             # samples that may wait for the learner; what comes on top is counted and lost
# model_hz = 50.0                   # how often the model is published, at most, 1/s
# recorder = "recordings/x"         # folder for recordings of the samples; relative to this file
# recorder_bytes = 2000000000       # its share of the disk, bytes; the oldest segments go first
# checkpoints = "checkpoints/x"     # folder for the learner's state, from which a start goes on; relative to this file
# checkpoint_s = 1.0                # how often, s of samples
# checkpoints_kept = 32             # the newest, and older ones further and further apart
# stand_in = "mpi"                  # the baseline that answers where the model is not to be trusted; default: the best
# blend_share = 0.5                 # distance outside the learnt domain, in learnt spans, where it answers alone
# stale_s = 2.0                     # age of the newest sample learnt at which answers are flagged as stale, s; 0: never
# last_good_s = 60.0                # time after which a model that is no longer renewed gives way to the stand-in, s

# [axis.learner]                    # settings of the learner, see docs/learner.md
# [axis.competition]                # how models are judged and exchanged, see docs/learner.md
# [axis.retuning]                   # of the re-tuning in the background, see docs/learner.md
# [axis.diagnosis]                  # of the diagnosis in the background, see docs/diagnosis.md
"""


@dataclass(frozen=True, slots=True)
class AxisConfig:
    """One axis of a service; the fields are those of the example. ``limits.y_*`` are infinite where not given."""

    name: str
    model: Path
    limits: Limits
    served: str = AUTO
    learn: str = LEARN
    compete: tuple[str, ...] = COMPETE
    snapshot_every: int = 20
    snapshots_kept: int = 256
    queue_samples: int = 20_000
    model_hz: float = 50.0
    recorder: Path | None = None
    recorder_bytes: int = 2_000_000_000
    checkpoints: Path | None = None
    checkpoint_s: float = 1.0
    checkpoints_kept: int = 32
    stand_in: str = ""
    blend_share: float = 0.5
    stale_s: float = 2.0
    last_good_s: float = 60.0
    learner: dict[str, Any] = field(default_factory=dict)
    diagnosis: WatchConfig = field(default_factory=WatchConfig)
    competition: CompetitionConfig = field(default_factory=CompetitionConfig)
    retuning: RetuningConfig = field(default_factory=RetuningConfig)


@dataclass(frozen=True, slots=True)
class ServeConfig:
    """A whole service: one stage, one or more axes."""

    stage: str
    axes: tuple[AxisConfig, ...]
    listen: tuple[str, ...] = (DEFAULT_ENDPOINT,)
    connect: tuple[str, ...] = ()
    zenoh_config: Path | None = None
    standby_listen: tuple[str, ...] = ()
    lease_s: float = 1.0


def read_config(path: Path | str, insecure_beyond_loopback: bool = False) -> ServeConfig:
    """Read a configuration file. Raises InputError naming the file, the key, what was got and what was expected.

    ``insecure_beyond_loopback`` as the key of that name: what is reached from other machines may be open to all there.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise FieldError(
            str(path), str(error), "a readable TOML file", "'dehyst serve --example' prints one to begin with"
        ) from error
    return parse_config(text, str(path), path.parent, insecure_beyond_loopback)


def parse_config(text: str, where: str, folder: Path, insecure_beyond_loopback: bool = False) -> ServeConfig:
    """The configuration in ``text``; paths in it are relative to ``folder``, ``where`` begins every message."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise FieldError(where, f"no TOML ({error})", "a TOML file", "mend the line named") from error
    table = Table(data, where)
    stage = check_name(f"{where}: stage", table.take("stage", str))
    listen = tuple(_endpoints(table, "listen", [DEFAULT_ENDPOINT]))
    connect = tuple(_endpoints(table, "connect", []))
    standby_listen = tuple(_endpoints(table, "standby_listen", []))
    lease_s = table.take("lease_s", float, 1.0, lambda value: 0.1 <= value <= 60, "0.1 to 60 s")
    zenoh_config = table.path("zenoh_config", folder)
    insecure = table.take("insecure_beyond_loopback", bool, False) or insecure_beyond_loopback
    check_reach(where, (*listen, *standby_listen), connect, zenoh_config, insecure)
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
    return ServeConfig(stage, axes, listen, connect, zenoh_config, standby_listen, lease_s)


def _axis(entry: Any, where: str, folder: Path) -> AxisConfig:
    if not isinstance(entry, dict):
        raise FieldError(where, repr(entry), "a [[axis]] table")
    table = Table(entry, where)
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
        served=table.take("served", str, AUTO),
        learn=table.take("learn", str, LEARN),
        compete=_names(table.take("compete", list, list(COMPETE)), f"{where}.compete"),
        snapshot_every=table.within("snapshot_every", 20, 1, 100_000),
        snapshots_kept=table.within("snapshots_kept", 256, 1, 4096),
        queue_samples=table.within("queue_samples", 20_000, 1, 10_000_000),
        model_hz=table.take("model_hz", float, 50.0, lambda value: 0 < value <= 1000, "0 to 1000 1/s"),
        recorder=table.path("recorder", folder),
        recorder_bytes=table.within("recorder_bytes", 2_000_000_000, 1_000_000, 10**15),
        checkpoints=table.path("checkpoints", folder),
        checkpoint_s=table.take("checkpoint_s", float, 1.0, lambda value: 0.05 <= value <= 86400, "0.05 to 86400 s"),
        checkpoints_kept=table.within("checkpoints_kept", 32, 2, 10_000),
        stand_in=table.take("stand_in", str, ""),
        blend_share=table.take("blend_share", float, 0.5, lambda value: 0 < value <= 100, "more than 0, at most 100"),
        stale_s=table.take("stale_s", float, 2.0, lambda value: 0 <= value < math.inf, "0 s or more"),
        last_good_s=table.take("last_good_s", float, 60.0, lambda value: 0 < value < math.inf, "a positive time in s"),
        learner=table.take("learner", dict, {}),
        diagnosis=_diagnosis(table.take("diagnosis", dict, {}), f"{where}.diagnosis", folder),
        competition=build_settings(CompetitionConfig, table.take("competition", dict, {}), f"{where}.competition"),
        retuning=build_settings(RetuningConfig, table.take("retuning", dict, {}), f"{where}.retuning"),
    )
    table.done()
    return axis


def _names(values: list[Any], where: str) -> tuple[str, ...]:
    for i, value in enumerate(values):
        if not isinstance(value, str):
            raise FieldError(f"{where}[{i}]", repr(value), "the name of a model in the file")
    return tuple(values)


def _diagnosis(entry: dict[str, Any], where: str, folder: Path) -> WatchConfig:
    config = build_settings(WatchConfig, entry, where)
    return replace(config, reports=str(folder / config.reports)) if config.reports else config


def _endpoints(table: Table, key: str, default: list[str]) -> list[str]:
    return [check_endpoint(key, endpoint) for endpoint in table.take(key, list, default)]
