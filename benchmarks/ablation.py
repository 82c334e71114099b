"""What each rule and each constant of the learner is worth: without the rule, and with half and twice the constant.

``python -m benchmarks.ablation --json out/ablation.jsonl`` runs the learner as it is over short cases, then once for
each variant, and prints what gets worse. A variant without any row that gets worse beyond chance is worth nothing on
these cases. The file is continued where it ends, if the code of the learner and the cases are the same.

Variants
--------
rules : those of `RULES` are switched off, one at a time, each in a process forked from this one; those that are part of
    the compiled order of a sample in a copy of the source, as constants are.
fields (``--fields``) : half and twice each number of the learner's frozen configuration, integers rounded.
constants (``--constants``) : likewise each number that a module of ``adaptive/online`` assigns, each in a copy of the
    source, since compiled code does not see a changed constant. A copy is compiled anew, which takes some two minutes
    of processor time before its first case: name the constants that are in doubt (``--rules``).

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
rms of the logarithms of the errors' ratios over the cases of a row is what chance does to one of them. The logarithms
of a variant's ratios are divided by that, cut at ``CUT``, and summed over the cases; the sum over the root of their
number is normal for a variant that does what other noise does. A row is worse where this exceeds the quantile of
``LEVEL`` divided by all comparisons of the run (Bonferroni), and the geometric mean grows by ``LEAST`` too; or where
the verdict gets worse in ``FLIPS`` cases more than it gets better, and in more than it does by other noise. The learner
is deterministic: equal numbers are equal for sure.
"""

from __future__ import annotations

import argparse
import ast
import functools
import gc
import hashlib
import itertools
import math
import multiprocessing
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final, Protocol
from unittest import mock

import numpy as np

import dehyst.adaptive.online
from benchmarks.foreign import LARGE_S, NAMED_S
from benchmarks.foreign_motions import BAND
from benchmarks.measured import RECORDS, Cut, data_folder, learnt
from benchmarks.records import add_line, read_lines
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online import gates, glitch_or_jump, sensor_trust
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.online.gates import LEARNT, PASSED, UNEXCITED, EnvelopeConfig, Judgement
from dehyst.adaptive.online.intake import Intake
from dehyst.adaptive.types import FloatArray, Sample
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
        last = min(cut.u_V.size, cut.split + SAMPLES + 2 * LATER)
        cut = replace(cut, u_V=cut.u_V[:last], y_um=cut.y_um[:last])
        train_V = cut.u_V[: cut.split]
        model = identify_one(LEARN, train_V, cut.y_um[: cut.split], cut.dt_s, 500)
        assert isinstance(model, LssvmInverse)
        test = cut.whole.part(cut.split, last)
        return cls(name, "record", model, test, cut.dt_s, cut.limits, float(np.ptp(train_V)))

    def run(self, noise: int, settings: Settings) -> Numbers:
        test, dt_s = self.test.part(noise * LATER, len(self.test)), self.dt_s
        got, said = learnt(self.model, test, dt_s, self.limits, settings)
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


# --- Rules.


@dataclass(frozen=True, slots=True)
class Text:
    """A text that stands once in a module of ``adaptive/online``, and what replaces it."""

    module: str
    old: str
    new: str

    def replace_in(self, root: Path) -> None:
        path = root / "adaptive" / "online" / f"{self.module}.py"
        source = path.read_text()
        if source.count(self.old) != 1:
            raise ValueError(f"{path.name}: {self.old!r} stands there {source.count(self.old)} times, expected once")
        path.write_text(source.replace(self.old, self.new))


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule that can be switched off: what is replaced (owner, name) and by what; for a property by its getter.

    source : texts that are replaced where the rule is compiled.
    """

    name: str
    replaces: tuple[tuple[Any, str, Any], ...] = ()
    source: tuple[Text, ...] = ()

    def switch_off(self) -> None:
        """In this process, for ever."""
        for owner, name, new in self.replaces:
            mock.patch.object(owner, name, new).start()


def _always(value: Any) -> Callable[..., Any]:
    return lambda *_, **__: value


_nothing: Final = _always(None)


def _no_missing_motion(self: Intake, sample: Sample, missing: int, _model: Any) -> Any:
    return self._restart(sample, gates.GAP if missing else gates.SETTLING)


def _begin_anew(self: Intake, sample: Sample, _hold: Any) -> Any:
    return self._restart(sample, gates.SETTLING)


_CREDIT: Final = "if not (known and front.credit > 0):"
_BEGINS: Final = "begins = front.until_control <= 0 and t.checks and f.tells"
_JUDGES: Final = "return self._tells and self.credit > 0"
RULES: Final = (
    Rule("surprising readings are held", source=(
        Text("gates", "return float(usual + KINK_SHARE * state.kink_V / span_V)", "return 1e300"),)),
    Rule("motion not yet learnt is not judged", source=(
        Text("intake", "return bool(abs(slope) <= BEYOND * known[0] and abs(bend) <= BEYOND * known[1])",
             "return True"),)),
    Rule("only a model with credit judges", source=(
        Text("step", _CREDIT, "if not known:"), Text("step", _BEGINS, "begins = False"),
        Text("intake", _JUDGES, "return self._tells"))),
    Rule("a model judges at all", source=(
        Text("step", _CREDIT, "if True:"), Text("step", _BEGINS, "begins = False"),
        Text("intake", _JUDGES, "return False"))),
    Rule("repeated readings are none", source=(
        Text("gates", 'return GLITCH if state.same >= REPEATED and moved else ""', 'return ""'),)),
    Rule("readings must follow the drive", source=(
        Text("step", "if now % c.check_every != 0 or t.saturated or not f.tells:", "if True:"),)),
    Rule("undecided readings go on trial", ((Intake, "_give_up", _begin_anew),)),
    Rule("jumps move the frame", ((glitch_or_jump, "_is_jump", _always(False)),)),
    Rule("memories after a gap", ((Intake, "after_gap", _no_missing_motion),)),
    Rule("rest: only the constant is learnt", source=(
        Text("gates", "return (count - state.moved) * dt_s > config.rest_s", "return False"),)),
    Rule("creep at rest moves the frame", source=(
        Text("drift", "return -min(max(gained_um", "return 0.0 * min(max(gained_um"),)),
    Rule("envelope refuses frames", ((EnvelopeConfig, "refuses", _always("")),)),
    Rule("fall back to the frozen model", source=(
        Text("gates", "if not self.fallback and learnt > FALLBACK_RATIO * frozen + floor_V:", "if False:"),)),
    Rule("roll back to a mark", source=(
        Text("step", "ROLLBACK_S, MARK_S, REFERENCE_S = 0.5,", "ROLLBACK_S, MARK_S, REFERENCE_S = 1e300,"),)),
    Rule("validity", source=(Text("gates", "if self.valid and rms > leave_V:", "if False:"),)),
    Rule("doubt after a jump", ((Judgement, "add_doubt", _nothing),)),
    Rule("a sudden change is detected", source=(Text("drift", "DEAD_S = 0.25", "DEAD_S = 1e300"),)),
    Rule("a jump opens the filter", source=(
        Text("drift", "expect_change(self.config, self.state, self._x, self._P, self._burst)", "pass"),
        Text("step", "expect_change(c.drift, r.filter.state, A.beta, A.covariance, A.bursts)", "pass"))),
    Rule("outliers are refused by the filter", source=(Text("drift", "> c.gate_sigma**2 *", "> 1e18 *"),)),
    Rule("the window learns", source=(
        Text("step", "if window.due((track.count - 1 - c.lag) // c.filter_every, c.window_every):", "if False:"),)),
    Rule("the kernel part", source=(
        Text("step", '["kernel_V"] = steps.predict(W, A.point)', '["kernel_V"] = 0.0'),
        Text("kernel_window", "share * self._window.alpha, share * self._window.bias",
             "0.0 * self._window.alpha, 0.0"))),
    Rule("only the share that is borne out of the kernel part", source=(
        Text("step", "_weigh(r.share, t.kernel_V, left_V, c.step_s)", "pass"),)),
    Rule("the noise follows from the innovations", source=(Text("drift", "c.alike_s / step_s * s.slow_V2", "0.0"),)),
    Rule("the window learns at moving phases", source=(
        Text("kernel_window", "return updates % every == (updates // every) % every", "return updates % every == 0"),)),
    Rule("smoother settles first", source=(
        Text("gates", "return state.since_start <= config.settle", "return False"),)),
    Rule("the place is reckoned again", ((Intake, "reckon_by", _nothing),)),
    Rule("trial: shifted readings must bend alike", ((sensor_trust, "bends_otherwise", _always(False)),)),
)  # fmt: skip


# --- Variants.


@dataclass(frozen=True, slots=True)
class Literal:
    """A number in the source: the file under the root of the project, where it stands there, and what replaces it."""

    path: Path
    line: int
    begin: int
    end: int
    new: str

    def replace_in(self, root: Path) -> None:
        lines = (root / self.path).read_bytes().splitlines(keepends=True)
        line = lines[self.line - 1]
        lines[self.line - 1] = line[: self.begin] + self.new.encode() + line[self.end :]
        (root / self.path).write_bytes(b"".join(lines))


@dataclass(frozen=True, slots=True)
class Variant:
    """One change of the learner: a rule without which it runs, or other settings. ``of`` : what it belongs to."""

    name: str
    of: str
    rule: Rule | None = None
    settings: Settings = field(default_factory=dict)
    value: str = ""
    #: What is replaced in a copy of the source, in which it runs then.
    edits: tuple[Literal | Text, ...] = ()


#: Names of the factors.
FACTORS: Final = {"half": 0.5, "twice": 2.0}


def scaled(value: float, factor: float) -> float:
    """A number times a factor; an integer rounded, but moved by one at least."""
    if not isinstance(value, int):
        return value * factor
    moved = round(value * factor)
    return moved if moved != value or not value else value + (1 if factor > 1.0 else -1)


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
                found.append(Variant(f"{label} {name}", label, None, {table: new} if table else new, f"{value}"))
    return found


#: Root of the project, and what the benchmark needs of it.
ROOT: Final = Path(__file__).parents[1]
NEEDED: Final = ("dehyst", "adaptive", "baselines", "sim", "service", "lab", "benchmarks", "tests")
#: Marks, which are no constants.
NO_CONSTANTS: Final = frozenset({"NOWHERE"})


def constants() -> Iterator[tuple[str, Path, ast.Constant]]:
    """(name, file, number) of each number but 0 that a module of ``adaptive/online`` assigns, alone or in a tuple."""
    for path in sorted(Path(dehyst.adaptive.online.__file__).parent.glob("*.py")):
        for node in ast.parse(path.read_bytes()).body:
            if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
                continue
            target, value = node.targets[0] if isinstance(node, ast.Assign) else node.target, node.value
            pairs = [(target, value)]
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs = list(zip(target.elts, value.elts, strict=True))
            for target, value in pairs:
                try:
                    ast.literal_eval(value)
                except ValueError:
                    continue
                numbers = [n for n in ast.walk(value) if isinstance(n, ast.Constant) and type(n.value) in (int, float)]
                for at, number in enumerate(numbers):
                    name = ast.unparse(target) + (f"[{at}]" if len(numbers) > 1 else "")
                    if number.value and name not in NO_CONSTANTS:
                        yield f"{path.stem}.{name}", path.relative_to(ROOT), number


def constant_variants() -> list[Variant]:
    """Half and twice each constant."""
    found = []
    for label, path, number in constants():
        assert isinstance(number.value, int | float)
        assert number.end_col_offset is not None
        for name, factor in FACTORS.items():
            new = repr(scaled(number.value, factor))
            literal = Literal(path, number.lineno, number.col_offset, number.end_col_offset, new)
            found.append(Variant(f"{label} {name}", label, value=repr(number.value), edits=(literal,)))
    return found


def rule_variants() -> list[Variant]:
    """Each rule switched off."""
    return [Variant(rule.name, rule.name, rule, edits=rule.source) for rule in RULES]


# --- Running.


#: A process may take this many times what the learner as it is takes, s of processor time at least.
MOST_TIME, LEAST_S = 8.0, 60.0
#: A copy of the source may take as much more to compile and to identify its stages.
COMPILE_S: Final = 600.0


def _work(cases: Sequence[Case], variant: Variant, noise: int, most_s: float, towards: Connection) -> None:
    """Run cases in a process of its own; sends (name, numbers) as they end."""
    resource.setrlimit(resource.RLIMIT_CPU, (int(most_s), int(most_s) + 5))
    if variant.rule:
        variant.rule.switch_off()
    for case in cases:
        try:
            numbers = case.run(noise, variant.settings)
        except Exception as error:
            numbers = {"failed": f"{type(error).__name__}: {error}"[:200]}
        towards.send((case.name, numbers))


def _work_in_copy(select: Sequence[str], variant: Variant, most_s: float, towards: Connection) -> None:
    """Run the learner as it is in a copy of the source with what differs; sends (name, numbers) at the end.

    select : options of the command that choose the cases.
    """
    with tempfile.TemporaryDirectory(prefix="ablation-") as name:
        root = Path(name)
        for folder in NEEDED:
            shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", root)
        for edit in variant.edits:
            edit.replace_in(root)
        results = root / "results.jsonl"
        command = [sys.executable, "-m", "benchmarks.ablation", "--bare", "--json", str(results), *select]
        limit = (int(most_s + COMPILE_S), int(most_s + COMPILE_S) + 5)
        resource.setrlimit(resource.RLIMIT_CPU, limit)
        env = os.environ | {"PYTHONPATH": str(root)}
        done = subprocess.run(command, cwd=root, env=env, stderr=subprocess.PIPE, text=True)
        if done.returncode:
            _say(f"{variant.name}: {done.stderr[-500:]}")
            sys.exit(done.returncode)
        for entry in read_lines([results]):
            for pair in entry["cases"].items():
                towards.send(pair)


def run_all(
    plan: Sequence[tuple[Variant, int]], cases: Sequence[Case], select: Sequence[str], jobs: int, most_s: float
) -> Iterator[tuple[Variant, int, dict[str, Numbers]]]:
    """(variant, noise, numbers by case) as they end; each in a forked process, which may take ``most_s``.

    select : options of the command that choose ``cases``.
    """
    context, waiting = multiprocessing.get_context("fork"), list(plan)
    running: dict[Any, tuple[Variant, int, Any, dict[str, Numbers]]] = {}
    while waiting or running:
        while waiting and len(running) < jobs:
            variant, noise = waiting.pop(0)
            source, towards = context.Pipe(duplex=False)
            if variant.edits:
                process = context.Process(target=_work_in_copy, args=(select, variant, most_s, towards))
            else:
                process = context.Process(target=_work, args=(cases, variant, noise, most_s, towards))
            process.start()
            towards.close()
            running[source] = (variant, noise, process, {})
        for source in wait(list(running)):
            variant, noise, process, numbers = running[source]
            try:
                numbers.update([source.recv()])
            except EOFError:
                process.join()
                del running[source]
                ended = {"failed": f"the process ended: {process.exitcode}"}
                yield variant, noise, {case.name: numbers.get(case.name, ended) for case in cases}


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


def worse_rows(
    variant: ByCase, base: ByCase, repeated: Sequence[ByCase], groups: Mapping[str, Sequence[str]], comparisons: int
) -> list[Row]:
    """The rows in which a variant is worse than the learner as it is, beyond chance.

    groups : names of the cases by group. comparisons : all that are made.
    """
    limit = statistics.NormalDist().inv_cdf(1.0 - LEVEL / max(comparisons, 1))
    found = []
    for group, names in groups.items():
        for measure in FLOORS:
            change = logs(variant, base, names, measure)
            by_noise = np.array([logs(one, base, names, measure) for one in repeated])
            scale = max(float(np.sqrt(np.mean(by_noise**2))), LEAST_CHANCE)
            z = float(np.clip(change / scale, -CUT, CUT).sum()) / math.sqrt(len(names))
            by = math.exp(float(change.mean()))
            if z > limit and by >= LEAST:
                found.append(Row(group, measure, by))
        for measure in VERDICTS:
            more = flips(variant, base, names, measure)
            by_chance = max((abs(flips(one, base, names, measure)) for one in repeated), default=0)
            if more >= FLIPS and more > by_chance:
                found.append(Row(group, measure, more))
    return found


def different(variant: ByCase, base: ByCase) -> list[str]:
    """The cases that have not come to the same numbers, to the last bit."""
    return [name for name in variant if variant[name] != base[name]]


# --- The table.

HEAD = ("what", "value", "half / off", "twice")


@dataclass(frozen=True, slots=True)
class Results:
    """The numbers of all variants so far, by name; the groups of cases; what was planned."""

    base: ByCase
    repeated: list[ByCase]
    groups: Mapping[str, Sequence[str]]
    variants: dict[str, ByCase]
    planned: Sequence[Variant]

    @property
    def comparisons(self) -> int:
        return len(self.planned) * sum(len(FLOORS) for _ in self.groups)

    def worse(self, name: str) -> list[Row]:
        return worse_rows(self.variants[name], self.base, self.repeated, self.groups, self.comparisons)


def _told(results: Results, name: str) -> str:
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
        "changes nothing, to the last bit": [], "worth nothing: no row gets worse beyond chance": [],
        "worth its place": [],
    }  # fmt: skip
    kinds = list(parts)
    for of, variants in groups.items():
        names = [variant.name for variant in variants]
        if not results.variants.keys() >= {*names}:
            continue
        cells = [_told(results, name) for name in names]
        line = (of, variants[0].value, cells[0], *(cells[1:] or "-"))
        worth = any(results.worse(name) for name in names)
        parts[kinds[0 if {*cells} == {"the same"} else 2 if worth else 1]].append(line)
    cases = sum(len(names) for names in results.groups.values())
    texts = [
        f"{cases} cases ({', '.join(f'{len(names)} {group}' for group, names in results.groups.items())}), "
        f"{len(results.variants)} of {len(results.planned)} variants"
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the variants, or print the table of a file."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ablation", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rules", default="", metavar="NAME[,NAME]", help="only what has one of these in its name")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument("--fields", action="store_true", help="the fields of the learner's configuration instead")
    kinds.add_argument("--constants", action="store_true", help="the constants in the learner's source instead")
    kinds.add_argument("--bare", action="store_true", help="no variant: add the learner as it is to --json, and end")
    parser.add_argument("--only", default="", metavar="CASE", help="cases with this in the name")
    parser.add_argument("--quick", action="store_true", help="fewer than half of the cases")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes at a time (1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="add a line for each variant; go on where it ends")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the table here, again after each variant")
    given = parser.parse_args(arguments)
    if given.jobs < 1:
        parser.error(f"--jobs: got {given.jobs}, expected at least 1")
    planned = field_variants() if given.fields else constant_variants() if given.constants else rule_variants()
    wanted = given.rules.split(",")
    for name in wanted:
        if not any(name in variant.of for variant in planned):
            parser.error(f"--rules: got {name!r}, expected a part of a name: {', '.join({v.of: 0 for v in planned})}")
    planned = [variant for variant in planned if any(name in variant.of for name in wanted)]
    begun = time.monotonic()
    cases = all_cases(given.quick, given.only)
    if not cases:
        parser.error(f"--only: got {given.only!r}, expected a part of a case's name")
    _say(f"{len(cases)} cases prepared in {time.monotonic() - begun:.0f} s")
    if given.bare:
        add_line(given.json, {"mark": fingerprint(cases), "variant": UNMODIFIED, "cases": as_it_is(cases)})
        return 0
    select = (["--quick"] if given.quick else []) + ["--only", given.only]
    print(table(ablate(cases, planned, given.jobs, given.json, given.table, select)))
    return 0


def ablate(
    cases: Sequence[Case], planned: Sequence[Variant], jobs: int = 1, path: Path | None = None, to: Path | None = None,
    select: Sequence[str] = (),
) -> Results:  # fmt: skip
    """Run the learner as it is, its repetitions, and the variants that ``path`` does not hold yet.

    select : options of the command that choose ``cases``, for the copies of the source.
    ``to`` : file for the table, written anew after each variant. Exits where a case gives other numbers than before.
    """
    groups = {group: [case.name for case in cases if case.group == group] for group in GROUPS}
    groups = {group: names for group, names in groups.items() if names}
    mark = fingerprint(cases)
    done = read(path, mark)
    # In this process, which loads all that is compiled.
    begin = time.process_time()
    base = as_it_is(cases)
    seconds = time.process_time() - begin
    if UNMODIFIED not in done:
        add_line(path, {"mark": mark, "variant": UNMODIFIED, "cases": base})
    elif changed := different(done[UNMODIFIED], base):
        raise SystemExit(f"{path}: {changed[0]} came to other numbers than now: another machine, or another build")
    noises = {f"{NOISE} {k}": k for k in range(1, REPEATED + 1)}
    plan = [(Variant(name, NOISE), k) for name, k in noises.items()] + [(variant, 0) for variant in planned]
    plan = [entry for entry in plan if entry[0].name not in done]
    _say(f"{len(plan)} variants to run, {len(done)} results in the file")
    known = {variant.name for variant in planned}
    repeated = [numbers for name, numbers in done.items() if name in noises]
    results = Results(base, repeated, groups, {name: n for name, n in done.items() if name in known}, planned)
    # What is kept in the caches of functions was computed with all rules.
    for made in [made for made in gc.get_objects() if type(made) is functools._lru_cache_wrapper]:
        made.cache_clear()
    begun = time.monotonic()
    for k, (variant, noise, numbers) in enumerate(
        run_all(plan, cases, select, jobs, max(LEAST_S, MOST_TIME * seconds)), 1
    ):
        add_line(path, {"mark": mark, "variant": variant.name, "cases": numbers})
        if noise:
            repeated.append(numbers)
        else:
            results.variants[variant.name] = numbers
        left_s = (len(plan) - k) * (time.monotonic() - begun) / k
        said = f"{len(different(numbers, base))} cases differ" if noise else _told(results, variant.name)
        _say(f"[{left_s / 60.0:.0f} min left] {variant.name}: {said}")
        if to and repeated:
            to.write_text(table(results) + "\n")
    return results


def as_it_is(cases: Sequence[Case]) -> dict[str, Numbers]:
    """The numbers of the unmodified learner by case."""
    found = {}
    for case in cases:
        found[case.name] = case.run(0, {})
        _say(f"{case.name}: {', '.join(f'{name} {value:.3g}' for name, value in found[case.name].items())}")
    return found


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def read(path: Path | None, mark: str) -> dict[str, ByCase]:
    """The results in a file by variant, of the same learner and cases."""
    entries = read_lines([path]) if path and path.exists() else []
    return {entry["variant"]: entry["cases"] for entry in entries if entry["mark"] == mark}


if __name__ == "__main__":
    raise SystemExit(main())
