"""What each rule and each constant of the learner is worth: without the rule, and with half and twice the constant.

``python -m benchmarks.ablation --json out/ablation.jsonl`` runs the learner as it is over short cases, then once for
each variant, and prints what gets worse. A variant without any row that gets worse beyond chance is worth nothing on
these cases. The file is continued where it ends, if the code of the learner and the cases are the same.

Variants
--------
rules : those of `RULES` are switched off, one at a time.
constants : numbers at the level of the modules of ``adaptive/online``, found in their source; half and twice, integers
    rounded, of a pair each number by itself, of longer tuples all numbers at once. 0 has no factor and stays.
fields (``--fields``) : the numbers of the learner's frozen configuration, likewise.

Cases
-----
Runs of random stages (``tests/foreign/plants.py``) with an event, or with the motion of a user, in closed loop through
the axis, the learner without competitors, and replays of measured records (``DEHYST_DATA``). Each gives: the median
error and the worst mean over half a second, from the event on, percent of the range (of a record: of the voltage); the
longest time above 5 %; the share of good samples that is refused; of sensor faults whether they are named in time; of
other runs whether something is named. A row is one of these numbers over a group of cases.

Chance
------
All cases run again with other noise of the sensor (of a record: begun some samples later), the learner as it is. The
rms of the logarithms of the errors' ratios is what chance does to a case (half of it from all cases of its group, as
two repetitions say little). The logarithms of a variant's ratios are divided by that, cut at ``CUT``, and summed over
the cases of a row; the sum over the root of their number is normal for a variant that does what other noise does. A
row is worse where this exceeds the quantile of ``LEVEL`` divided by all comparisons of the run (Bonferroni: a run in
which nothing matters lists something with a probability of at most ``LEVEL``, as far as other noise is a measure of
chance), and the geometric mean grows by ``LEAST`` too; or where the verdict gets worse in ``FLIPS`` cases more than it
gets better, and in more than it does by other noise. The table says how many rows other noise alone makes worse by
this rule. The learner is deterministic: equal numbers are equal for sure. Where no row is worse, but a single case is
by more than ``CUT`` times what chance does to it, or a verdict is, it is open what the rule is worth: run more cases.

How a constant is shifted
-------------------------
In a process forked from this one, in all modules that import it. Compiled functions that read it, and those that call
them, are compiled anew, since compiled code does not see a changed constant. A case that goes through no line that
reads the constant gives the same numbers, and is not run. A constant that is read while a module is imported is not
shifted, and the table says so.
"""

from __future__ import annotations

import argparse
import ast
import dis
import functools
import hashlib
import itertools
import json
import math
import multiprocessing
import resource
import statistics
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, Final, Protocol
from unittest import mock

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher

import dehyst.adaptive.online
from benchmarks.foreign import LARGE_S, NAMED_S
from benchmarks.foreign_motions import BAND
from benchmarks.measured import RECORDS, Cut, data_folder, replayed
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import drift, gates, glitch_or_jump, intake, learner, sensor_trust
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.drift import DriftConfig, RestCreep
from dehyst.adaptive.online.gates import LEARNT, PASSED, UNEXCITED, EnvelopeConfig
from dehyst.adaptive.online.intake import Intake
from dehyst.adaptive.online.kernel_window import ResidualWindow
from dehyst.adaptive.online.learner import Judgement, Learner
from dehyst.adaptive.smoothing import smooth_recording
from dehyst.adaptive.types import FloatArray, InverseModel, Sample
from dehyst.lab.rehearsal import (
    SENSOR,
    Event,
    IdentifiedPlant,
    PlantFactory,
    RehearsalConfig,
    draw,
    identify,
    run_event,
)
from dehyst.lab.rehearsal.outcome import moving_mean
from dehyst.service.answers.guard import Limits
from dehyst.service.config.learner import learner_config
from dehyst.service.config.settings import LEARN
from dehyst.service.identification.identifying import Stretch, identify_one
from dehyst.service.reports.tables import markdown
from tests.foreign.motions import motion
from tests.foreign.plants import random_plant, with_traits

#: The numbers that a case came to, by name; ``failed`` if it raised.
Numbers = dict[str, Any]
#: Settings of the learner that differ from the defaults, as in a configuration's table.
Settings = dict[str, Any]

# --- Cases.

#: When the event comes at the earliest and at the latest, s; longest fault; closed loop after it, s.
AT_S, OVER_S, AFTER_S = (3.0, 3.5), 1.2, 4.0
#: Begin of the part of a motion that counts, and its length, s.
MOTION_S: Final = 2.5
#: Samples of a record that are replayed, share of them that does not count, and later begin with other noise, samples.
SAMPLES, SKIPPED, LATER = 5000, 0.2, 7
#: Samples of a query and between two snapshots.
BLOCK: Final = 20
#: Error that is large, percent. A good sample is refused unless its verdict is one of these.
LARGE_PCT, TAKEN = 5.0, (LEARNT, PASSED, UNEXCITED)
#: First seed; the stages are those of 1 kHz and of 500 Hz in turns from there on; a motion has one of 1 kHz.
FIRST_SEED: Final = 500_000_000
#: Classes of events, each on two stages; motions; names of records. With ``--quick`` the first stages of so many.
EVENTS: Final = (
    "stuck_noise", "sensor_gain", "sign", "foreign", "gain_at_once", "zero_at_once", "knock", "bursts", "gap", "losses",
    "stuck", "lag_fast",
)  # fmt: skip
MOTIONS: Final = ("raster:10", "binary", "tone:50", "raster:5", "raster:20", "noise")
MEASURED: Final = ("stack, 1 Hz", "raster, 15 Hz", "mirror 200 mV, 0", "Bouc-Wen, est", "foreign, gain-up-a", "case 10")
QUICK: Final = (10, 2, 2)


class Case(Protocol):
    """A run of the learner. ``group``: "sensor", "intact", "motion" or "record"."""

    name: str
    group: str

    def run(self, noise: int, settings: Settings) -> Numbers:
        """What it comes to; ``noise``: 0, or the number of a repetition by chance."""
        ...


@dataclass(frozen=True, slots=True)
class LoopCase:
    """A closed loop with an event, or with a motion."""

    name: str
    group: str
    seed: int
    factory: PlantFactory
    known: IdentifiedPlant
    config: RehearsalConfig
    event: Event

    @classmethod
    def of(cls, name: str, seed: int) -> LoopCase:
        factory = random_plant(seed)
        low_V, high_V = factory.traits.excite_V
        config = RehearsalConfig(
            excite_low_V=low_V, excite_high_V=high_V, after_s=AFTER_S, block=BLOCK, snapshot_every=BLOCK, compete=()
        )
        if name in EVENTS:
            at_s = float(np.random.default_rng([seed, 22]).uniform(*AT_S))
            event = draw(name, seed, at_s)
            event = replace(event, over_s=min(event.over_s, OVER_S))
            group = "sensor" if event.category == SENSOR else "intact"
        else:
            config = replace(config, reference=motion(name), band=BAND)
            event, group = Event("none", "none", MOTION_S), "motion"
        return cls(f"{name} {seed}", group, seed, factory, identify(factory, config), config, event)

    def run(self, noise: int, settings: Settings) -> Numbers:
        factory = with_traits(random_plant(self.seed), seed=self.seed + noise) if noise else self.factory
        run = run_event(factory, self.known, replace(self.config, learner=settings), self.event, self.seed)
        course, out, dt_s = run.adaptive, run.outcome, self.known.dt_s
        error_pct = 100.0 / run.range_um * np.abs(course.wanted_um - course.true_um)
        at, end = round(self.event.at_s / dt_s), round(self.event.end_s / dt_s)
        good = np.ones(error_pct.size, dtype=np.bool_)
        if self.group == "sensor":
            good[at:end] = False
        taken = [code for code, name in enumerate(course.verdicts) if name in TAKEN]
        # The start is the same for all.
        good[: round(0.5 / dt_s)] = False
        refused = 1.0 - float(np.mean(np.isin(course.verdict[good], taken)))
        numbers = _numbers(error_pct[at:], dt_s, refused) | {"large_s": out.adaptive.large_s}
        if self.group == "sensor":
            return numbers | {"unnamed": not out.named_s <= NAMED_S}
        return numbers | {"accused": bool(out.troubles)}


@dataclass(frozen=True, slots=True)
class RecordCase:
    """A replay of a measured record."""

    name: str
    group: str
    model: LssvmInverse
    test: Stretch
    dt_s: float
    limits: Limits
    span_V: float

    @classmethod
    def of(cls, cut: Cut, name: str) -> RecordCase:
        """Raises what an identification raises."""
        smoother, n = LearnerConfig().smoother(cut.dt_s), cut.split
        last = min(cut.u_V.size, n + SAMPLES + 2 * LATER)
        pieces = [slice(0, n), slice(n, last)] if cut.jump else [slice(0, last)]
        moved = np.concatenate([smooth_recording(cut.y_um[piece], smoother) for piece in pieces])
        u_V, y_um = cut.u_V[:last], cut.y_um[:last]
        whole = Stretch(u_V, y_um, moved, np.ones(u_V.size, dtype=np.bool_))
        model = identify_one(LEARN, u_V[:n], y_um[:n], cut.dt_s, 500)
        assert isinstance(model, LssvmInverse)
        (u_low, u_high), (y_low, y_high) = (
            (float(x.min() - 0.25 * np.ptp(x)), float(x.max() + 0.25 * np.ptp(x))) for x in (u_V, y_um)
        )
        limits = Limits(u_low, u_high, math.inf, y_low, y_high)
        return cls(name, "record", model, whole.part(n, last), cut.dt_s, limits, float(np.ptp(u_V[:n])))

    def run(self, noise: int, settings: Settings) -> Numbers:
        test, dt_s = self.test.part(noise * LATER, len(self.test)), self.dt_s
        made = Learner.from_model(self.model, learner_config(settings, self.limits, "learner"))
        said: list[str] = []

        def teach(part: slice) -> None:
            for k in range(part.start, part.stop):
                said.append(made.handle(Sample(k, k * dt_s, float(test.u_V[k]), float(test.y_um[k]))))

        def newest() -> tuple[int, InverseModel, FloatArray] | None:
            snapshot = made.snapshot()
            memory = made.memory_for(snapshot)
            return None if memory is None else (made.seq, snapshot, memory)

        got = replayed(test, dt_s, teach, newest, lambda _seq, at, memory, to: at.feedforward(*to, memory).u_V)
        first = round(SKIPPED * len(test))
        error_pct = np.nan_to_num(100.0 / self.span_V * np.abs(got - test.u_V)[first:])
        refused = float(np.mean([name not in TAKEN for name in said[first:]]))
        over = error_pct > LARGE_PCT
        return _numbers(error_pct, dt_s, refused) | {"large_s": float(over.sum()) * dt_s, "accused": False}


def _numbers(error_pct: FloatArray, dt_s: float, refused: float) -> Numbers:
    window = min(max(1, round(0.5 / dt_s)), error_pct.size)
    worst = float(moving_mean(error_pct, window).max())
    return {"median": float(np.median(error_pct)), "worst": worst, "refused": refused}


def all_cases(quick: bool, only: str = "") -> list[Case]:
    """The cases, with their models identified. A record that is missing is left out, and said."""
    cases: list[Case] = []
    events, motions, records = QUICK if quick else (2 * len(EVENTS), len(MOTIONS), len(MEASURED))
    taken = set[int]()
    # Two stages for each class of events: the second ones after all the first ones, with the other sample time.
    wanted = [(name, i, (i + i // len(EVENTS)) % 2) for i, name in enumerate((*EVENTS, *EVENTS))]
    wanted += [(name, i, 0) for i, name in enumerate(MOTIONS)]
    for name, i, slow in wanted:
        seed = next(seed for seed in itertools.count(FIRST_SEED) if seed not in taken and _fits(name, seed, bool(slow)))
        taken.add(seed)
        if only in name and i < (events if name in EVENTS else motions):
            cases.append(LoopCase.of(name, seed))
    for name in MEASURED[:records]:
        if only not in name:
            continue
        record = next(record for record in RECORDS if record.name == name)
        try:
            cases.append(RecordCase.of(Cut.of(record, data_folder()), name))
        except OSError as error:
            print(f"{name}: left out: {error.filename or error}: missing; set DEHYST_DATA", file=sys.stderr)
    return cases


def _fits(name: str, seed: int, slow: bool) -> bool:
    traits = random_plant(seed).traits
    rings = bool(traits.modes) and traits.modes[0][0] < 300.0
    return round(1.0 / traits.dt_s) == (500 if slow else 1000) and not (rings and name in MOTIONS)


# --- Constants in the source.


@dataclass(frozen=True, slots=True)
class Constant:
    """A number at the level of a module. ``at``: its place in a pair; None for a number, or for all of a tuple."""

    module: str
    name: str
    value: Any
    at: int | None = None

    @property
    def label(self) -> str:
        place = "" if self.at is None else f"[{self.at}]"
        return f"{self.module.rpartition('.')[2]}.{self.name}{place}"

    @property
    def present(self) -> Any:
        """What a shift changes."""
        return self.value if self.at is None else self.value[self.at]

    def shifted(self, factor: float) -> Any:
        """The new value of the module's name."""
        if self.at is not None:
            return tuple(scaled(x, factor) if i == self.at else x for i, x in enumerate(self.value))
        if isinstance(self.value, tuple):
            return tuple(scaled(x, factor) for x in self.value)
        return scaled(self.value, factor)


def scaled(value: float, factor: float) -> float:
    """A number times a factor; an integer rounded, but moved by one at least."""
    if not isinstance(value, int):
        return value * factor
    moved = round(value * factor)
    return moved if moved != value or not value else value + (1 if factor > 1.0 else -1)


#: Numbers that stand for nothing, or for a place in an array.
NO_CONSTANTS: Final = frozenset({"NOWHERE"})


def constants_of(text: str, module: str) -> list[Constant]:
    """The numbers, and tuples of numbers, that a module assigns in its source."""
    found = []
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign):
            targets, value = node.targets, node.value
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            targets, value = [node.target], node.value
        else:
            continue
        for target in targets:
            names, values = [target], [value]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                names, values = target.elts, value.elts
            for name, one in zip(names, values, strict=True):
                if isinstance(name, ast.Name) and name.id not in NO_CONSTANTS:
                    found.extend(_constants(module, name.id, _number(one)))
    return found


def _constants(module: str, name: str, value: Any) -> Iterator[Constant]:
    if isinstance(value, tuple) and len(value) == 2:
        yield from (Constant(module, name, value, at) for at in (0, 1) if value[at])
    elif value is not None and (any(value) if isinstance(value, tuple) else value):
        yield Constant(module, name, value)


def _number(node: ast.expr) -> Any:
    """The number or the tuple of numbers that a literal stands for; None for anything else."""
    try:
        value = ast.literal_eval(node)
    except (ValueError, TypeError):
        return None
    parts = value if isinstance(value, tuple) else (value,)
    return value if parts and all(isinstance(x, int | float) and not isinstance(x, bool) for x in parts) else None


#: The order in which modules are taken; any other one comes after them.
ORDER: Final = (
    "sensor_trust", "intake", "glitch_or_jump", "learner", "track", "gates", "drift"
)  # fmt: skip


def all_constants() -> list[Constant]:
    """Those of the modules of ``adaptive/online``."""
    folder = Path(dehyst.adaptive.online.__file__).parent
    modules = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    modules.sort(key=lambda name: ORDER.index(name) if name in ORDER else len(ORDER))
    return [
        constant
        for name in modules
        for constant in constants_of((folder / f"{name}.py").read_text(), f"dehyst.adaptive.online.{name}")
    ]


# --- Who reads a constant, and how it is shifted.

#: Packages in which readers are looked for.
PACKAGES: Final = ("dehyst", "benchmarks", "tests")
#: A line of a file. A function is entered at its first line.
Place = tuple[str, int]


def place_of(code: CodeType) -> Place:
    return code.co_filename, code.co_firstlineno


def lines_of(code: CodeType, names: Collection[str]) -> frozenset[Place]:
    """The lines of a function on which one of the names is read, as a name or as an attribute."""
    return frozenset(
        (code.co_filename, at.positions.lineno)
        for at in dis.get_instructions(code)
        if at.opname.startswith("LOAD_") and at.argval in names and at.positions and at.positions.lineno
    )


@dataclass(frozen=True, slots=True)
class Loaded:
    """A loaded module of the project: its functions, what it imports by name (local name -> origin), and the names
    that are read while it is imported."""

    module: ModuleType
    codes: tuple[CodeType, ...]
    imported: dict[str, tuple[str, str]]
    modules: frozenset[str]
    at_import: frozenset[str]

    @classmethod
    def of(cls, module: ModuleType, path: str) -> Loaded:
        text = Path(path).read_text()
        tree = ast.parse(text)
        imported, modules = {}, set[str]()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                for alias in node.names:
                    imported[alias.asname or alias.name] = (node.module, alias.name)
                    modules.add(f"{node.module}.{alias.name}")
            elif isinstance(node, ast.Import):
                modules.update(alias.name for alias in node.names)
        codes = tuple(_functions(compile(text, path, "exec")))
        return cls(module, codes, imported, frozenset(modules), frozenset(_read_at_import(tree)))


def _functions(code: CodeType) -> Iterator[CodeType]:
    """All functions in a code object, themselves in functions or not."""
    for inner in code.co_consts:
        if isinstance(inner, CodeType):
            if inner.co_flags & 0x2:  # CO_NEWLOCALS: a function, not the body of a class
                yield inner
            yield from _functions(inner)


def _read_at_import(node: ast.AST) -> Iterator[str]:
    """Names that are read outside of functions; annotations are not evaluated."""
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
        yield node.id
    elif isinstance(node, ast.Attribute):
        yield node.attr
    parts: Iterable[ast.AST] = ast.iter_child_nodes(node)
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        parts = [*node.decorator_list, *node.args.defaults, *(d for d in node.args.kw_defaults if d)]
    elif isinstance(node, ast.Lambda):
        parts = []
    elif isinstance(node, ast.AnnAssign):
        parts = [node.value] if node.value else []
    for part in parts:
        yield from _read_at_import(part)


@functools.cache
def loaded() -> dict[str, Loaded]:
    """The loaded modules of the project by name."""
    found = {}
    for name, module in list(sys.modules.items()):
        path = vars(module).get("__file__")
        if name.partition(".")[0] in PACKAGES and path:
            found[name] = Loaded.of(module, path)
    return found


@dataclass(frozen=True, slots=True)
class Readers:
    """Where a name is read.

    names : (module, local name) under which it is bound. places : lines that read it, or that call compiled code which
    does. compiled : the names of compiled functions to be compiled anew, callees first. at_import : modules that
    read it while they are imported.
    """

    names: tuple[tuple[str, str], ...]
    places: frozenset[Place]
    compiled: tuple[tuple[str, str], ...]
    at_import: tuple[str, ...]


def bound_as(module: str, name: str) -> list[tuple[str, str]]:
    """(module, local name) of all names that a module's name is bound to by imports, itself first."""
    names = [(module, name)]
    for origin in names:
        names += [
            (other, local)
            for other, it in loaded().items()
            for local, source in it.imported.items()
            if source == origin and (other, local) not in names
        ]
    return names


@functools.cache
def readers_of(module: str, name: str) -> Readers:
    """Who reads a module's name."""
    names = bound_as(module, name)
    places, compiled, at_import = set[Place](), list[tuple[str, str]](), list[str]()
    waiting = [(module, name)]
    for origin in waiting:
        bound = bound_as(*origin)
        read: dict[str, set[str]] = {}
        for where, local in bound:
            read.setdefault(where, set()).add(local)
        for other, it in loaded().items():
            if origin[0] in it.modules:  # as an attribute of the module
                read.setdefault(other, set()).add(origin[1])
        for where, locals_ in read.items():
            it = loaded()[where]
            if origin == (module, name) and locals_ & it.at_import:
                at_import.append(where)
            for code in it.codes:
                places |= lines_of(code, locals_)
            for own, value in vars(it.module).items():
                compiles = isinstance(value, Dispatcher) and value.py_func.__module__ == where
                if compiles and lines_of(value.py_func.__code__, locals_):
                    if (where, own) in compiled:
                        compiled.remove((where, own))  # after what it calls
                    compiled.append((where, own))
                    waiting.append((where, own))
    return Readers(tuple(names), frozenset(places), tuple(compiled), tuple(at_import))


def shift(constant: Constant, value: Any) -> None:
    """Give a constant another value in this process, for ever."""
    readers = readers_of(constant.module, constant.name)
    for where, local in readers.names:
        mock.patch.object(loaded()[where].module, local, value).start()
    for where, name in readers.compiled:
        old: Any = vars(loaded()[where].module)[name]
        new = numba.jit(**old.targetoptions)(old.py_func)
        for other, local in bound_as(where, name):
            mock.patch.object(loaded()[other].module, local, new).start()
    forget_results()


def forget_results() -> None:
    """Empty the caches of functions: what is in them was computed from other values, or without reading any."""
    for it in loaded().values():
        for made in list(vars(it.module).values()):
            if isinstance(made, functools._lru_cache_wrapper) and made.__module__ != __name__:
                made.cache_clear()


# --- Rules.


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule that can be switched off: what is replaced (owner, name) and by what; for a property by its getter."""

    name: str
    replaces: tuple[tuple[Any, str, Any], ...]

    @property
    def places(self) -> frozenset[Place]:
        """The functions that are replaced; empty where a number is."""
        found = set()
        for owner, name, _ in self.replaces:
            old = vars(owner)[name]
            function = old.fget if isinstance(old, property) else old
            if not callable(function):
                return frozenset()
            found.add(place_of(function.__code__))
        return frozenset(found)

    def switch_off(self) -> None:
        """In this process, for ever."""
        for owner, name, new in self.replaces:
            old = vars(owner)[name]
            mock.patch.object(owner, name, property(new) if isinstance(old, property) else new).start()


def _always(value: Any) -> Callable[..., Any]:
    return lambda *_, **__: value


_nothing: Final = _always(None)


def _no_missing_motion(self: Intake, sample: Sample, missing: int, _model: Any) -> Any:
    return self._restart(sample, gates.GAP if missing else gates.SETTLING)


def _begin_anew(self: Intake, sample: Sample, _hold: Any) -> Any:
    return self._restart(sample, gates.SETTLING)


def _no_kernel(self: ResidualWindow) -> tuple[FloatArray, FloatArray, float]:
    support, alpha, _ = _ARRAYS(self)
    return support, np.zeros_like(alpha), 0.0


_ARRAYS: Final = ResidualWindow.arrays
_UPDATE: Final = drift.update


def _ungated(c: DriftConfig, *rest: Any) -> str:
    return _UPDATE(_without_gate(c), *rest)


@functools.cache
def _without_gate(c: DriftConfig) -> DriftConfig:
    return replace(c, gate_sigma=1e9)


def _of_fixed_noise(c: DriftConfig, *rest: Any) -> str:
    return _UPDATE(_without_alike(c), *rest)


@functools.cache
def _without_alike(c: DriftConfig) -> DriftConfig:
    return replace(c, alike_s=0.0)


def _fixed_phase(now: int, every: int) -> bool:
    return now % every == 0


def _always_judges(self: Intake) -> bool:
    return self._tells


RULES: Final = (
    Rule("surprising readings are held", ((gates, "surprise", _always(math.inf)),)),
    Rule("motion not yet learnt is not judged", ((intake, "is_known", _always(True)),)),
    Rule("only a model with credit judges", ((Intake, "_judges", _always_judges), (Intake, "_check_model", _nothing))),
    Rule("a model judges at all", ((Intake, "_judges", _always(False)), (Intake, "_check_model", _nothing))),
    Rule("repeated readings are none", ((gates, "check_repeats", _always("")),)),
    Rule("readings must follow the drive", ((Intake, "follow", _always(False)),)),
    Rule("undecided readings go on trial", ((Intake, "_give_up", _begin_anew),)),
    Rule("jumps move the frame", ((glitch_or_jump, "_is_jump", _always(False)),)),
    Rule("memories after a gap", ((Intake, "_after_gap", _no_missing_motion),)),
    Rule("rest: only the constant is learnt", ((Intake, "rests", _always(False)),)),
    Rule("creep at rest moves the frame", ((RestCreep, "shift_um", _always(0.0)),)),
    Rule("envelope refuses frames", ((EnvelopeConfig, "refuses", _always("")),)),
    Rule("fall back to the frozen model", ((Judgement, "choose", _always(False)),)),
    Rule("roll back to a mark", ((learner, "ROLLBACK_S", math.inf),)),
    Rule("validity", ((Judgement, "decide", _always(True)),)),
    Rule("doubt after a jump", ((Judgement, "add_doubt", _nothing),)),
    Rule("a sudden change is detected", ((drift, "DEAD_S", math.inf),)),
    Rule("a jump opens the filter", ((drift.DriftFilter, "expect_change", _nothing),)),
    Rule("outliers are refused by the filter", ((drift, "update", _ungated),)),
    Rule("the window learns", ((ResidualWindow, "learn", _always(LEARNT)),)),
    Rule("the kernel part", ((ResidualWindow, "predict", _always(0.0)), (ResidualWindow, "arrays", _no_kernel))),
    Rule("only the share that is borne out of the kernel part", ((ResidualWindow, "weigh", _nothing),)),
    Rule("the noise follows from the innovations", ((drift, "update", _of_fixed_noise),)),
    Rule("the window learns at moving phases", ((learner, "due", _fixed_phase),)),
    Rule("smoother settles first", ((gates, "settling", _always(False)),)),
    Rule("the place is reckoned again", ((Intake, "reckon_by", _nothing),)),
    Rule("trial: shifted readings must bend alike", ((sensor_trust, "bends_otherwise", _always(False)),)),
)  # fmt: skip


# --- Variants.


@dataclass(frozen=True, slots=True)
class Variant:
    """One change of the learner. ``of`` : what it belongs to. ``places`` : lines without which it does nothing."""

    name: str
    of: str
    kind: str
    settings: Settings
    begin: Callable[[], None]
    places: frozenset[Place]
    value: str = ""
    impossible: str = ""


#: Names of the factors.
FACTORS: Final = {"half": 0.5, "twice": 2.0}


def variants_of(constant: Constant) -> list[Variant]:
    """Half and twice a constant."""
    readers = readers_of(constant.module, constant.name)
    found = []
    for name, factor in FACTORS.items():
        value = constant.shifted(factor)
        begin = functools.partial(shift, constant, value)
        why = f"read while {readers.at_import[0]} is imported" if readers.at_import else ""
        found.append(
            Variant(f"{constant.label} {name}", constant.label, "constant", {}, begin, readers.places,
                    f"{constant.present}", why)
        )  # fmt: skip
    return found


def field_variants() -> list[Variant]:
    """Half and twice each number of the learner's configuration."""
    found = []
    whole = LearnerConfig()
    tables: list[tuple[str, Any]] = [("", whole)]
    tables += [(f.name, getattr(whole, f.name)) for f in fields(whole) if is_dataclass(getattr(whole, f.name))]
    for table, config in tables:
        for entry in fields(config):
            value = getattr(config, entry.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < abs(value) < gates.ABSURD:
                continue
            label = f"{table or 'learner'}.{entry.name}"
            for name, factor in FACTORS.items():
                new = {entry.name: scaled(value, factor)}
                settings = {table: new} if table else new
                found.append(Variant(f"{label} {name}", label, "field", settings, _nothing, frozenset(), f"{value}"))
    return found


def rule_variants() -> list[Variant]:
    """Each rule switched off."""
    return [Variant(rule.name, rule.name, "rule", {}, rule.switch_off, rule.places) for rule in RULES]


# --- Running.


def entered_in(call: Callable[[], Numbers], inside: Collection[str]) -> tuple[Numbers, frozenset[Place]]:
    """The result of a call, and the lines that it has gone through: all lines of the files ``inside``, of other files
    the first lines of functions."""
    places = set[Place]()

    def see_line(frame: FrameType, _: str, __: Any) -> Any:
        places.add((frame.f_code.co_filename, frame.f_lineno))
        return see_line

    def see_call(frame: FrameType, _: str, __: Any) -> Any:
        places.add(place_of(frame.f_code))
        return see_line if frame.f_code.co_filename in inside else None

    before = sys.gettrace()
    sys.settrace(see_call)
    try:
        numbers = call()
    finally:
        sys.settrace(before)
    return numbers, frozenset(places)


#: A process may take this many times what the learner as it is takes, s of processor time at least.
MOST_TIME, LEAST_S = 8.0, 60.0


def _work(
    cases: Sequence[Case], variant: Variant, noise: int, towards: Connection, most_s: float
) -> None:  # pragma: no cover - in a process
    """Run cases in a process of its own; sends (name, numbers) as they end."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(most_s), int(most_s) + 5))
    begun = False
    for case in cases:
        try:
            if not begun:
                variant.begin()
                begun = True
            numbers = case.run(noise, variant.settings)
        except Exception as error:
            numbers = {"failed": f"{type(error).__name__}: {error}"[:200]}
        towards.send((case.name, numbers))
    towards.close()


@dataclass(slots=True)
class Job:
    """A process that runs a variant."""

    variant: Variant
    noise: int
    cases: Sequence[Case]
    source: Connection
    process: Any
    numbers: dict[str, Numbers]


def run_all(
    plan: Sequence[tuple[Variant, int, Sequence[Case]]], jobs: int, seconds: float
) -> Iterator[tuple[Variant, int, dict[str, Numbers]]]:
    """(variant, noise, numbers by case) as they end; each in a forked process. ``seconds``: of an ordinary one."""
    context, running, waiting = multiprocessing.get_context("fork"), list[Job](), list(plan)
    most_s = max(LEAST_S, MOST_TIME * seconds)
    while waiting or running:
        while waiting and len(running) < jobs:
            variant, noise, cases = waiting.pop(0)
            source, towards = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(cases, variant, noise, towards, most_s))
            process.start()
            towards.close()
            running.append(Job(variant, noise, cases, source, process, {}))
        ready = wait([job.source for job in running])
        for job in [job for job in running if job.source in ready]:
            try:
                name, numbers = job.source.recv()
                job.numbers[name] = numbers
            except EOFError:
                job.process.join()
                running.remove(job)
                for case in job.cases:
                    job.numbers.setdefault(case.name, {"failed": f"the process ended: {job.process.exitcode}"})
                yield job.variant, job.noise, job.numbers


# --- Comparison.

#: Probability that a run in which nothing matters lists something. Least growth of the geometric mean of a row, and
#: least number of verdicts. Logarithms of ratios are cut at so many times what chance does.
LEVEL, LEAST, FLIPS, CUT = 0.05, 1.05, 2, 5.0
#: Errors below these do not count: percent, percent, share of the samples. Least that chance does to a logarithm.
FLOORS, LEAST_CHANCE = {"median": 0.01, "worst": 0.05, "refused": 0.01}, 0.02
GROUPS: Final = ("sensor", "intact", "motion", "record")
VERDICTS: Final = ("large", "unnamed", "accused", "failed")
#: Names of the learner as it is, and of its repetitions by chance.
UNMODIFIED, NOISE = "as it is", "other noise"

ByCase = Mapping[str, Numbers]


@dataclass(frozen=True, slots=True)
class Row:
    """A row that has got worse: by which factor (of the geometric mean), or in how many verdicts more."""

    group: str
    measure: str
    by: float

    def __str__(self) -> str:
        if self.measure in VERDICTS:
            return f"{self.group} {self.measure} +{self.by:.0f}"
        return f"{self.group} {self.measure} × {self.by:.2f}"


def logs(one: ByCase, other: ByCase, names: Sequence[str], measure: str) -> FloatArray:
    """(n,) logarithms of ratios of a measure, of the cases that both have without a failure; 0 for others."""
    found = np.zeros(len(names))
    for i, name in enumerate(names):
        a, b = one[name], other[name]
        if "failed" in a or "failed" in b:
            continue
        x, y = (float(n[measure]) if math.isfinite(n[measure]) else 1e6 for n in (a, b))
        found[i] = math.log((x + FLOORS[measure]) / (y + FLOORS[measure]))
    return found


def verdict(numbers: Numbers, name: str) -> bool:
    """Whether a case is bad in one respect."""
    if name == "failed" or "failed" in numbers:
        return "failed" in numbers and name == "failed"
    return bool(numbers["large_s"] > LARGE_S) if name == "large" else bool(numbers.get(name, False))


def flips(one: ByCase, other: ByCase, names: Sequence[str], measure: str) -> int:
    """In how many cases more the verdict has got worse than better."""
    return sum(verdict(one[name], measure) - verdict(other[name], measure) for name in names)


def chance(base: ByCase, repeated: Sequence[ByCase], names: Sequence[str], measure: str) -> FloatArray:
    """(n,) what chance does to a logarithm: half from the case itself, half from all cases."""
    squares = np.mean([logs(one, base, names, measure) ** 2 for one in repeated], axis=0)
    found: FloatArray = np.sqrt(0.5 * squares + 0.5 * squares.mean())
    return np.maximum(found, LEAST_CHANCE)


def worse_rows(
    variant: ByCase, base: ByCase, repeated: Sequence[ByCase], groups: Mapping[str, Sequence[str]], comparisons: int,
    sign: int = 1,
) -> list[Row]:  # fmt: skip
    """The rows in which a variant is worse than the learner as it is, beyond chance; ``sign`` -1: better.

    groups : names of the cases by group. comparisons : all that are made.
    """
    limit = statistics.NormalDist().inv_cdf(1.0 - LEVEL / max(comparisons, 1))
    found = []
    for group, names in groups.items():
        for measure in FLOORS:
            change = sign * logs(variant, base, names, measure)
            if not change.any():
                continue
            scale = chance(base, repeated, names, measure)
            z = float(np.clip(change / scale, -CUT, CUT).sum()) / math.sqrt(len(names))
            by = math.exp(float(change.mean()))
            if z > limit and by >= LEAST:
                found.append(Row(group, measure, by))
        for measure in VERDICTS:
            more = sign * flips(variant, base, names, measure)
            by_chance = max((abs(flips(one, base, names, measure)) for one in repeated), default=0)
            if more >= FLIPS and more > by_chance:
                found.append(Row(group, measure, more))
    return found


def worse_cases(
    variant: ByCase, base: ByCase, repeated: Sequence[ByCase], groups: Mapping[str, Sequence[str]]
) -> list[str]:
    """Single cases that are worse by more than ``CUT`` times what chance does to them, or whose verdict is.

    They make no row: other noise does that to a case now and then. But a rule that few cases need is not worth nothing.
    """
    found = []
    for names in groups.values():
        for measure in FLOORS:
            change = logs(variant, base, names, measure)
            far = change > np.maximum(CUT * chance(base, repeated, names, measure), math.log(LEAST))
            found += [f"{names[k]}: {measure} × {math.exp(change[k]):.2f}" for k in np.flatnonzero(far)]
        for measure in VERDICTS:
            found += [f"{name}: {measure}" for name in names if flips(variant, base, [name], measure) > 0]
    return found


def different(variant: ByCase, base: ByCase) -> list[str]:
    """The cases that have not come to the same numbers, to the last bit."""
    return [name for name in variant if variant[name] != base[name]]


# --- The table.

HEAD = ("what", "value", "half / off", "twice", "better", "single cases that get worse")


@dataclass(frozen=True, slots=True)
class Results:
    """The numbers of all variants so far, by name; the groups of cases; what was planned.

    untested : variants whose lines no case goes through.
    """

    base: ByCase
    repeated: list[ByCase]
    groups: Mapping[str, Sequence[str]]
    variants: dict[str, ByCase]
    planned: Sequence[Variant]
    untested: set[str] = field(default_factory=set)

    @property
    def comparisons(self) -> int:
        return len(self.planned) * sum(len(FLOORS) for _ in self.groups)

    def worse(self, name: str, sign: int = 1) -> list[Row]:
        return worse_rows(self.variants[name], self.base, self.repeated, self.groups, self.comparisons, sign)

    def single(self, name: str) -> list[str]:
        return worse_cases(self.variants[name], self.base, self.repeated, self.groups)

    def by_chance(self) -> str:
        """What other noise alone makes worse by the same rules, each repetition judged by the others."""
        rows = cases = seen = 0
        for one in self.repeated:
            others = [other for other in self.repeated if other is not one]
            if others:
                rows += len(worse_rows(one, self.base, others, self.groups, self.comparisons))
                cases += len(worse_cases(one, self.base, others, self.groups))
                seen += len(self.groups) * (len(FLOORS) + len(VERDICTS))
        return f"{rows} of {seen} rows and {cases} single cases"


UNTESTED: Final = "no case goes there"


def _told(results: Results, name: str) -> str:
    if name not in results.variants:
        return "not run"
    if name in results.untested:
        return UNTESTED
    rows, moved = results.worse(name), different(results.variants[name], results.base)
    if rows:
        return "**" + ", ".join(map(str, rows)) + "**"
    return f"nothing beyond chance, {len(moved)} cases differ" if moved else "the same"


def table(results: Results) -> str:
    """Markdown: what changes nothing first, then what changes no row beyond chance, then what is worth its place."""
    groups: dict[str, list[Variant]] = {}
    for variant in results.planned:
        groups.setdefault(variant.of, []).append(variant)
    parts: dict[str, list[tuple[str, ...]]] = {
        "changes nothing, to the last bit": [], "worth nothing: no row and no case gets worse beyond chance": [],
        "open: single cases get worse, no row does": [], "worth its place": [], "not tested by these cases": [],
        "not shifted": [],
    }  # fmt: skip
    kinds = list(parts)
    for of, variants in groups.items():
        first = variants[0]
        done = [v for v in variants if v.name in results.variants]
        if first.impossible:
            parts[kinds[5]].append((of, first.value, first.impossible, "", "", ""))
            continue
        if len(done) < len(variants):
            continue
        cells = [_told(results, v.name) for v in variants]
        shifts = {v.name: f"{v.name.removeprefix(of).strip()} " if len(variants) > 1 else "" for v in variants}
        better = [f"{shift}{row}" for name, shift in shifts.items() for row in results.worse(name, -1)]
        single = [f"{shift}{text}" for name, shift in shifts.items() for text in results.single(name)]
        line = (of, first.value, cells[0], *(cells[1:] or "-"), ", ".join(better), "; ".join(single))
        same = all(cell in ("the same", UNTESTED) for cell in cells)
        worth = any(results.worse(v.name) for v in variants)
        untested = all(cell == UNTESTED for cell in cells)
        parts[kinds[4 if untested else 0 if same else 3 if worth else 2 if single else 1]].append(line)
    cases = sum(len(names) for names in results.groups.values())
    texts = [
        f"{cases} cases ({', '.join(f'{len(names)} {group}' for group, names in results.groups.items())}), "
        f"{len(results.variants)} of {sum(not v.impossible for v in results.planned)} variants; other noise alone "
        f"makes {results.by_chance()} worse by this rule"
    ]
    for kind, lines in parts.items():
        if lines:
            texts.append(f"### {kind} ({len(lines)})\n\n{markdown(HEAD, lines)}")
    return "\n\n".join(texts)


# --- Command line.


def fingerprint(cases: Sequence[Case]) -> str:
    """Of the learner's source and of the cases: results of others cannot be compared."""
    digest = hashlib.sha256()
    folder = Path(dehyst.adaptive.online.__file__).parent
    for path in sorted(folder.glob("*.py")):
        digest.update(path.read_bytes())
    digest.update("\n".join(sorted(case.name for case in cases)).encode())
    return digest.hexdigest()[:16]


#: Repetitions with other noise.
REPEATED: Final = 2


def planned_variants(given: argparse.Namespace) -> list[Variant]:
    """The variants that the arguments ask for. Exits where a name is unknown."""
    rules, constants = rule_variants(), [v for c in all_constants() for v in variants_of(c)]
    found = field_variants() if given.fields else []
    for names, some in ((given.constants, constants), (given.rules, rules)):
        if names is None:
            continue
        wanted = [name for name in names.split(",") if name]
        for name in wanted:
            if not any(name in variant.of for variant in some):
                raise SystemExit(f"{name!r}: in the name of no rule or constant")
        found += [variant for variant in some if not wanted or any(name in variant.of for name in wanted)]
    return found or [*rules, *constants]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the variants, or print the table of a file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ablation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    some = {"nargs": "?", "const": "", "metavar": "NAME[,NAME]"}
    parser.add_argument("--constants", **some, help="only constants, with one of these in the name")
    parser.add_argument("--rules", **some, help="only rules, with one of these in the name")
    parser.add_argument("--fields", action="store_true", help="only the fields of the learner's configuration")
    parser.add_argument("--only", default="", metavar="CASE", help="cases with this in the name")
    parser.add_argument("--quick", action="store_true", help="fewer than half of the cases")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes at a time (1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="add a line for each variant; go on where it ends")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the table here, again after each variant")
    given = parser.parse_args(arguments)
    if given.jobs < 1:
        parser.error("--jobs: expected at least 1")
    begun = time.monotonic()
    cases = all_cases(given.quick, given.only)
    if not cases:
        parser.error(f"--only: got {given.only!r}, expected a part of a case's name")
    _say(f"{len(cases)} cases prepared in {time.monotonic() - begun:.0f} s")
    text = table(ablate(cases, planned_variants(given), given.jobs, given.json, given.table))
    if given.table:
        given.table.write_text(text + "\n")
    print(text)
    return 0


def ablate(
    cases: Sequence[Case], planned: Sequence[Variant], jobs: int = 1, path: Path | None = None, to: Path | None = None
) -> Results:
    """Run the learner as it is, its repetitions, and the variants that ``path`` does not hold yet.

    ``to`` : file for the table, written anew after each variant. Exits where a case does not give the same twice.
    """
    groups = {group: [case.name for case in cases if case.group == group] for group in GROUPS}
    groups = {group: names for group, names in groups.items() if names}
    mark = fingerprint(cases)
    done, untested = read(path, mark)
    # As it is, in this process, which loads all that is compiled; twice, to see what is called.
    base, entered, seconds = dict[str, Numbers](), dict[str, frozenset[Place]](), dict[str, float]()
    inside = {file for variant in planned for file, _ in variant.places}
    for case in cases:
        begin = time.process_time()
        base[case.name] = case.run(0, {})
        seconds[case.name] = time.process_time() - begin
        forget_results()
        again, entered[case.name] = entered_in(functools.partial(case.run, 0, {}), inside)
        if again != base[case.name]:
            raise SystemExit(f"{case.name}: not deterministic: {base[case.name]}, then {again}")
        _say(f"{case.name}: {', '.join(f'{name} {value:.3g}' for name, value in again.items())}")
    if UNMODIFIED not in done:
        add(path, mark, UNMODIFIED, base, len(cases))
    elif changed := different(done[UNMODIFIED], base):
        raise SystemExit(f"{path}: {changed[0]} came to other numbers than now: another machine, or another build")
    plan: list[tuple[Variant, int, Sequence[Case]]] = []
    for k in range(1, REPEATED + 1):
        plan.append((Variant(f"{NOISE} {k}", NOISE, "noise", {}, _nothing, frozenset()), k, cases))
    for variant in planned:
        if not variant.impossible:
            # A variant whose lines are not gone through is the learner as it is.
            plan.append((variant, 0, [c for c in cases if not variant.places or variant.places & entered[c.name]]))
    plan = [entry for entry in plan if entry[0].name not in done]
    _say(f"{len(plan)} variants to run, {len(done)} results in the file")
    repeated = [done[name] for k in range(1, REPEATED + 1) if (name := f"{NOISE} {k}") in done]
    known = {variant.name for variant in planned}
    results = Results(base, repeated, groups, {name: n for name, n in done.items() if name in known}, planned)
    results.untested.update(untested)
    planned_s = sum(seconds[case.name] for _, _, part in plan for case in part)
    spent_s, begun = 0.0, time.monotonic()
    for variant, noise, numbers in run_all(plan, jobs, sum(seconds.values())):
        whole = {case.name: numbers.get(case.name, base[case.name]) for case in cases}
        add(path, mark, variant.name, whole, len(numbers))
        if not numbers:
            results.untested.add(variant.name)
        if noise:
            repeated.append(whole)
        else:
            results.variants[variant.name] = whole
        spent_s += sum(seconds[name] for name in numbers)
        left_s = (planned_s - spent_s) * (time.monotonic() - begun) / max(spent_s, 1e-9)
        said = f"{len(different(whole, base))} cases differ" if noise else _told(results, variant.name)
        _say(f"[{left_s / 60.0:.0f} min left] {variant.name} ({len(numbers)} cases run): {said}")
        if to and repeated:
            to.write_text(table(results) + "\n")
    return results


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def read(path: Path | None, mark: str) -> tuple[dict[str, ByCase], set[str]]:
    """The results in a file by variant, of the same learner and cases, and the variants for which no case was run."""
    found, untested = dict[str, ByCase](), set[str]()
    if path is None or not path.exists():
        return found, untested
    for line in path.read_text().splitlines():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue  # cut off
        if entry["mark"] == mark:
            found[entry["variant"]] = entry["cases"]
            if not entry["run"]:
                untested.add(entry["variant"])
    return found, untested


def add(path: Path | None, mark: str, name: str, cases: ByCase, run: int) -> None:
    """Add a line to a file. ``run`` : number of cases that were run; the others are as they are without the variant."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write(json.dumps({"mark": mark, "variant": name, "run": run, "cases": cases}) + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
