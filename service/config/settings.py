"""Configuration of ``dehyst serve``: one TOML file. The dataclasses here are its schema (`service.config.schema`)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from dehyst.baselines.competition.config import CompetitionConfig
from dehyst.service.answers.guard import Limits
from dehyst.service.background.settings import RetuningConfig, WatchConfig
from dehyst.service.config.correction import CorrectionConfig, RepetitionConfig
from dehyst.service.config.limits import limits_setting
from dehyst.service.config.schema import Setting, build_settings, parse_toml, read_text
from dehyst.service.fleet.settings import FleetSettings
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import AUTO, check_name
from dehyst.service.protocol.samples import MAX_COUNT
from dehyst.service.runtime.session import DEFAULT_ENDPOINT, check_endpoint
from dehyst.service.security.access import check_reach

#: The model that learns.
LEARN = "lssvm_adaptive"
#: Models that compete with the one that learns, where the model file has them.
COMPETE = ("linear", "mpi", "bouc_wen")
_LIMITS = limits_setting(
    "limits of what the service sends",
    "lowest displacement of a trajectory; default: 5 % beyond the identified range",
    "highest displacement of a trajectory; default: the same",
)
_LEARNER = Setting(help="settings of the learner, see docs/learner.md")
_COMPETITION = Setting(help="how models are compared and exchanged, see docs/learner.md")
_RETUNING = Setting(help="background tuning of hyper-parameters, see docs/learner.md")
_CORRECTION = Setting(help="correction by fresh readings, see docs/correction.md")
_REPETITION = Setting(help="correction of motion that repeats, see docs/correction.md")
_DIAGNOSIS = Setting(help="background diagnosis, see docs/diagnosis.md")


@dataclass(frozen=True, slots=True)
class AxisConfig:
    """One axis of a service: an ``[[axis]]`` table. ``limits.y_*`` are infinite where the file does not give them."""

    name: Annotated[str, Setting(help="name of the axis on the wire", check=check_name, example="x", shown=True)]
    model: Annotated[
        Path,
        Setting(
            help="model file from 'dehyst identify'",
            example="x.npz",
            shown=True,
            advice="make one with 'dehyst identify'",
        ),
    ]
    limits: Annotated[Limits, _LIMITS]
    served: Annotated[
        str, Setting(help='model that answers a query that names none; "auto": the best of those that learn')
    ] = AUTO
    learn: Annotated[str, Setting(help='model that learns; "" for none')] = LEARN
    compete: Annotated[
        tuple[str, ...], Setting(help='models that learn beside it; "auto" serves the best of all; [] for none')
    ] = COMPETE
    snapshot_every: Annotated[
        int, Setting(help="samples between two snapshots, which answer the queries", low=1, high=100_000)
    ] = 20
    snapshots_kept: Annotated[int, Setting(help="snapshots that a query can ask for by as_of", low=1, high=4096)] = 256
    query_points: Annotated[
        int, Setting(help="most points of one query; a query for more is refused", low=1, high=MAX_COUNT)
    ] = MAX_COUNT
    queue_samples: Annotated[
        int, Setting(help="samples that may wait for the learner; more are counted and dropped", low=1, high=10_000_000)
    ] = 20_000
    model_hz: Annotated[
        float, Setting(help="highest rate at which the model is published", unit="1/s", low=0, above=True, high=1000)
    ] = 50.0
    delta_hz: Annotated[
        float,
        Setting(help="highest rate at which changes of the model are published; 0: none", unit="1/s", low=0, high=1000),
    ] = 200.0
    recorder: Annotated[Path | None, Setting(help="folder for recordings", example="recordings/x")] = None
    recorder_bytes: Annotated[
        int,
        Setting(help="most disk that recordings take; the oldest go first", unit="bytes", low=1_000_000, high=10**15),
    ] = 2_000_000_000
    checkpoints: Annotated[
        Path | None,
        Setting(
            help="folder for the learner's state, which a restart continues",
            example="checkpoints/x",
        ),
    ] = None
    checkpoint_s: Annotated[
        float, Setting(help="time of samples between two checkpoints", unit="s", low=0.05, high=86400)
    ] = 7.0
    checkpoints_kept: Annotated[
        int, Setting(help="checkpoints kept: the newest, and older ones ever further apart", low=2, high=10_000)
    ] = 32
    stand_in: Annotated[
        str,
        Setting(help="baseline that answers where the model cannot be trusted; default: the best one", example="mpi"),
    ] = ""
    blend_share: Annotated[
        float,
        Setting(
            help="distance outside the learnt domain, in learnt spans, at which the baseline answers alone",
            low=0,
            above=True,
            high=100,
        ),
    ] = 0.5
    stale_s: Annotated[
        float, Setting(help="age of the newest learnt sample at which answers are flagged; 0: never", unit="s", low=0)
    ] = 2.0
    last_good_s: Annotated[
        float,
        Setting(
            help="age at which a model that is not renewed gives way to the baseline",
            unit="s",
            low=0,
            above=True,
        ),
    ] = 60.0
    learner: Annotated[dict[str, Any], _LEARNER] = field(default_factory=dict)
    diagnosis: Annotated[WatchConfig, _DIAGNOSIS] = field(default_factory=WatchConfig)
    competition: Annotated[CompetitionConfig, _COMPETITION] = field(default_factory=CompetitionConfig)
    retuning: Annotated[RetuningConfig, _RETUNING] = field(default_factory=RetuningConfig)
    correction: Annotated[CorrectionConfig, _CORRECTION] = field(default_factory=CorrectionConfig)
    repetition: Annotated[RepetitionConfig, _REPETITION] = field(default_factory=RepetitionConfig)


@dataclass(frozen=True, slots=True)
class ServeConfig:
    """A whole service: one stage, one or more axes."""

    stage: Annotated[
        str,
        Setting(help="name of the stage on the wire: a-z, 0-9, _ and -", check=check_name, example="demo", shown=True),
    ]
    axes: Annotated[tuple[AxisConfig, ...], Setting(key="axis", help="one such table for each axis", shown=True)] = ()
    fleet: Annotated[
        FleetSettings | None, Setting(help="many axes as one batch, in place of [[axis]] tables; see docs/fleet.md")
    ] = None
    listen: Annotated[
        tuple[str, ...],
        Setting(help="where controllers, stage and viewer connect", check=check_endpoint, shown=True),
    ] = (DEFAULT_ENDPOINT,)
    connect: Annotated[
        tuple[str, ...], Setting(help="routers or other services to connect to", check=check_endpoint)
    ] = ()
    zenoh_config: Annotated[
        Path | None,
        Setting(
            help="TLS and access control for other machines, from 'dehyst access init'",
            example="service.json5",
        ),
    ] = None
    standby_listen: Annotated[
        tuple[str, ...],
        Setting(help="where 'dehyst serve --standby' listens; clients look for it there", check=check_endpoint),
    ] = ()
    key: Annotated[
        Path | None,
        Setting(
            help="file with the shared key; default: this user's, which the first start makes (docs/access.md)",
            example="dehyst.key",
        ),
    ] = None
    open: Annotated[
        bool, Setting(help="true: no key; nothing is signed, and everybody on the wire is believed (--open)")
    ] = False
    busy_after_s: Annotated[
        float,
        Setting(
            help="a query for more than 128 points that would take longer than this is refused as busy",
            unit="s",
            low=0.01,
            high=60,
        ),
    ] = 0.5
    lease_s: Annotated[
        float, Setting(help="silence after which a service counts as dead", unit="s", low=0.1, high=60)
    ] = 1.0
    insecure_beyond_loopback: Annotated[
        bool, Setting(help="true: whoever reaches an address on another machine may do everything")
    ] = False


def read_config(path: Path | str, insecure_beyond_loopback: bool = False) -> ServeConfig:
    """Read a configuration file. Raises InputError naming the file, the key, what was got and what was expected.

    ``insecure_beyond_loopback`` overrides the key of that name: endpoints on other machines need no protection.
    """
    path = Path(path)
    text = read_text(path, "'dehyst serve --example' prints one to begin with")
    return parse_config(text, str(path), path.parent, insecure_beyond_loopback)


def parse_config(text: str, where: str, folder: Path, insecure_beyond_loopback: bool = False) -> ServeConfig:
    """The configuration in ``text``; paths in it are relative to ``folder``, ``where`` begins every message."""
    config = build_settings(ServeConfig, parse_toml(text, where), f"{where}:", folder)
    insecure = config.insecure_beyond_loopback or insecure_beyond_loopback
    check_reach(where, (*config.listen, *config.standby_listen), config.connect, config.zenoh_config, insecure)
    if not config.listen and not config.connect:
        raise FieldError(f"{where}: listen", "nothing", "an endpoint to listen at, or one to connect to")
    if config.fleet is not None and config.axes:
        raise FieldError(f"{where}: fleet", "[[axis]] tables too", "one of the two", "serve them by two processes")
    if not config.axes and config.fleet is None:
        raise FieldError(f"{where}: axis", "none", "one or more [[axis]] tables, or a [fleet] table")
    names = [axis.name for axis in config.axes]
    if len(set(names)) < len(names):
        raise FieldError(f"{where}: axis", ", ".join(names), "a different name for each axis")
    _check_folders(where, config.axes)
    return replace(config, axes=tuple(_with_reports_in(folder, axis) for axis in config.axes))


def _check_folders(where: str, axes: tuple[AxisConfig, ...]) -> None:
    """Refuse one folder for the checkpoints, or for the recordings, of two axes. Raises FieldError."""
    for what in ("checkpoints", "recorder"):
        seen: dict[Path, str] = {}
        for axis in axes:
            folder = axis.checkpoints if what == "checkpoints" else axis.recorder
            other = None if folder is None else seen.setdefault(folder.resolve(), axis.name)
            if other not in (None, axis.name):
                raise FieldError(
                    f"{where}: axis {axis.name}: {what}",
                    f"{folder}, which is also that of axis {other}",
                    "a folder of its own for each axis",
                )


def _with_reports_in(folder: Path, axis: AxisConfig) -> AxisConfig:
    """The axis with its diagnosis' folder of reports taken from the folder of the file."""
    reports = axis.diagnosis.reports
    return replace(axis, diagnosis=replace(axis.diagnosis, reports=str(folder / reports))) if reports else axis
