"""How the service does on stages that it was not built for: stages, events and times drawn at random, in lockstep.

``python -m benchmarks.foreign --runs 500 --jobs 2 --json out/foreign.jsonl`` draws a stage, an event and its time for
each seed (``tests/foreign/plants.py``), rehearses it (``lab.rehearsal``), and prints two tables: the goals with the
results, and one row for each class of events. Errors are mean absolute errors in percent of the commanded range. The
file gets a line for each run as it ends; a further call goes on where it ends, and tabulates all that it holds.
``--table FILE`` prints the tables of finished runs. ``--line`` runs twelve fixed stages and prints one line.

``--healthy HOURS --json out/healthy.jsonl`` runs stages on which nothing happens until
the file holds that many hours of simulated time, and prints each trouble that was reported.

``--motions raster:10,tone:50 --runs 40 --json out/motions.jsonl`` runs motions that users make (``foreign_motions.py``)
on stages on which nothing happens; with ``--repetition`` also by followers with and without ``[axis.repetition]``.

``--controllers 1 5 20 --runs 10`` runs the corrections beside other controllers, with readings so many samples old
(``lab.rehearsal.controllers``), and prints medians and worst ones. A stage takes a minute or two.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import multiprocessing
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks import foreign_motions
from benchmarks.correction import course_of
from benchmarks.records import Record, add_line, read_lines, recorded, why_failed
from dehyst.lab.rehearsal import Event, RehearsalConfig, controllers, identify, run_event
from dehyst.lab.rehearsal.disturbance import BURSTS_HZ, CLASSES, SENSOR, SPIKES_HZ, draw
from dehyst.service.reports.tables import markdown
from tests.foreign.motions import MOTIONS, motion
from tests.foreign.plants import random_plant

#: The event comes so long after the start of the closed loop, s, and up to so much later.
SETTLE_S, LATER_S = 4.0, 1.5
#: Closed loop after the event, s.
AFTER_S = 5.0
#: Limits: time of motion within which a sensor fault must be named, s; time above 5 % of the range, s.
NAMED_S, LARGE_S = 0.5, 0.1
#: Step of the gain that the goal refers to, percent.
STEP_PCT = 6.0
#: Runs of ``--line``, class and seed. From seed 900000 on, each is the first whose stage has 1 kHz or less, a gain
#: that rises and falls in turn, and a mode that rings where it is knocked; chosen without looking at results.
LINE = (
    ("none", 900_001), ("knock", 900_008), ("gain_at_once", 900_009), ("gain_at_once", 900_017),
    ("zero_at_once", 900_018), ("spikes", 900_019), ("gap", 900_021), ("losses", 900_022),
    ("number_stray", 900_023), ("stuck_noise", 900_024), ("sensor_gain", 900_027), ("sign", 900_028),
)  # fmt: skip

#: Class of healthy runs in the files. Length of such a run: as many samples as this, within these limits, s.
HEALTHY, HEALTHY_SAMPLES, HEALTHY_S = "healthy", 300_000, (120.0, 300.0)
#: From here on the errors of a healthy run count, s: what comes before is the start.
HEALTHY_AT_S = 4.0

#: What makes a record, and what names it: the record without results.
Run = tuple[Callable[[], Record], Record]


def run_one(name: str, seed: int, after_s: float = AFTER_S, as_drawn: bool = False) -> Record:
    """One run with an event of the class ``name``, as JSON values. If it raises, the record holds the traceback.

    as_drawn : also such stages as move against their voltage after a turn, as no piezo does.
    """
    record: Record = {"seed": seed, "class": name}
    with recorded(record):
        factory = random_plant(seed, as_drawn=as_drawn)
        at_s = SETTLE_S + float(np.random.default_rng([seed, 22]).uniform(0.0, LATER_S))
        record["stage"] = factory.traits.summary()
        low_V, high_V = factory.traits.excite_V
        config = RehearsalConfig(excite_low_V=low_V, excite_high_V=high_V, after_s=after_s)
        known = identify(factory, config)
        run = run_event(factory, known, config, draw(name, seed, at_s), seed)
        record |= run.outcome.as_dict() | {"range_um": run.range_um, "heldout_mae_pct": known.heldout_mae_pct}
    return record


def run_healthy_stage(seed: int, block: int) -> Record:
    """A run in which nothing happens, as JSON values. If it raises, the record holds the traceback."""
    record: Record = {"seed": seed, "class": HEALTHY, "block": block}
    with recorded(record):
        factory = random_plant(seed)
        record["stage"] = factory.traits.summary()
        low_V, high_V = factory.traits.excite_V
        after_s = healthy_s(seed) - HEALTHY_AT_S
        config = RehearsalConfig(
            excite_low_V=low_V, excite_high_V=high_V, block=block, snapshot_every=block, after_s=after_s
        )
        run = run_event(factory, identify(factory, config), config, Event("none", "none", HEALTHY_AT_S), seed)
        course, out = run.adaptive, run.outcome.as_dict()
        start, error_um = round(HEALTHY_AT_S / factory.traits.dt_s), np.abs(course.wanted_um - course.true_um)
        record |= {
            "simulated_s": out["simulated_s"],
            "range_um": run.range_um,
            "figures": out["adaptive"],
            "mean_pct": 100.0 / run.range_um * float(error_um[start:].mean()),
            "troubles": [one | {"named_s": one["named_s"] + HEALTHY_AT_S} for one in out["troubles"]],
        }
    return record


def healthy_s(seed: int) -> float:
    """Length of a healthy run, s."""
    return float(np.clip(HEALTHY_SAMPLES * random_plant(seed).traits.dt_s, *HEALTHY_S))


def run_controllers(seed: int, ages: Sequence[int]) -> Record:
    """All controllers on a stage, as JSON values. If it raises, the record holds the traceback."""
    record: Record = {"seed": seed, "ages": list(ages)}
    with recorded(record):
        course = course_of(seed)
        found = controllers.compare(course.make, course.known, course.low_V, course.mode_Hz, ages, seed)
        record |= {"hysteresis": course.name, "controllers": [asdict(one) for one in found]}
    return record


# ---- plans


def event_runs(plan: Iterable[tuple[str, int]], after_s: float = AFTER_S) -> list[Run]:
    """The runs of (class, seed)."""
    return [(functools.partial(run_one, name, seed, after_s), {"seed": seed, "class": name}) for name, seed in plan]


def motion_runs(given: argparse.Namespace) -> list[Run]:
    """The runs of ``--motions``."""
    recording = foreign_motions.RECORDINGS[given.poor]
    return [
        (
            functools.partial(
                foreign_motions.run_motion, name, seed, recording, given.after, given.true_length, given.repetition
            ),
            {"seed": seed, "recording": recording, "motion": name},
        )
        for name, seed in foreign_motions.planned(given.motions, given.first_seed, given.runs)
    ]


def healthy_runs(hours: float, first_seed: int, block: int, kept: Sequence[Record]) -> list[Run]:
    """Runs of seeds that are not kept, until all that have not failed are ``hours`` long."""
    found, known, planned_h = list[Run](), {record["seed"] for record in kept}, _hours(kept)
    seeds = (seed for seed in itertools.count(first_seed) if seed not in known)
    while planned_h < hours:
        seed = next(seeds)
        planned_h += healthy_s(seed) / 3600.0
        named: Record = {"seed": seed, "class": HEALTHY, "block": block}
        found.append((functools.partial(run_healthy_stage, seed, block), named))
    return found


def run_all(plan: Sequence[Run], jobs: int) -> Iterator[Record]:
    """The runs of ``plan`` in the order in which they end. If a process dies, its run has failed."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    if jobs == 1:
        for run, _ in plan:
            yield run()
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = {pool.submit(run): lost for run, lost in plan}
        for done in as_completed(waiting):
            try:
                yield done.result()
            except BrokenProcessPool:
                yield waiting[done] | {"failed": "the process ended"}


def _hours(records: Iterable[Record]) -> float:
    """Simulated time of healthy runs, h."""
    return float(sum(record.get("simulated_s", 0.0) for record in records)) / 3600.0


# ---- what a run came to


def _numbers(values: Iterable[float | None]) -> np.ndarray:
    """(n,) numbers; JSON has null for values that are not finite."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _of(records: Iterable[Record], model: str, name: str) -> np.ndarray:
    return _numbers(record[model][name] for record in records)


def _at_rail(record: Record) -> bool:
    return bool(record["adaptive"]["ends_at_rail"])


def _large(record: Record) -> bool:
    return bool(record["adaptive"]["large_s"] > LARGE_S)


def _named(record: Record) -> bool:
    return record["named_s"] is not None and record["named_s"] <= NAMED_S


def _in_order(record: Record) -> bool:
    return record["sensor_excess"] is not None and record["sensor_excess"] <= 1.0


def _percentiles(values: np.ndarray, *shares: float, digits: int = 3) -> str:
    if not np.isfinite(values).any():
        return "-"
    return " / ".join(f"{value:.{digits}f}" for value in np.nanpercentile(values, shares))


def _count(records: Sequence[Record], holds: Callable[[Record], bool]) -> str:
    """``3 of 4``, or ``-`` of none."""
    return f"{sum(map(holds, records))} of {len(records)}" if records else "-"


def _parts(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """(runs with a working sensor, runs with a sensor fault), without those that failed."""
    done = [record for record in records if "failed" not in record]
    return [r for r in done if r["category"] != SENSOR], [r for r in done if r["category"] == SENSOR]


# ---- tables


GOALS_HEAD = ("what is measured", "goal", "these runs")


def goals(records: Sequence[Record]) -> str:
    """Markdown: the goals, each with the results and the runs that it was taken over."""
    intact, sensors = _parts(records)
    knocks = [record for record in intact if record["class"] == "knock"]
    steps = [record for record in intact if record["class"] == "gain_at_once"]
    first = _of(steps, "adaptive", "first_second_pct")
    size_pct = 100.0 * np.abs(_numbers(record["event"]["size"] for record in steps))
    ratio = _numbers(record["worst_ratio"] for record in knocks)
    settled = _of(intact, "adaptive", "settled_pct")
    hours = sum(record["healthy_s"] for record in (*intact, *sensors)) / 3600.0
    false = sum(len(record["false_troubles"]) for record in (*intact, *sensors))
    rows = [
        (
            "stage intact: runs that end at a rail, or are above 5 % of the range for longer than 0.1 s",
            "0",
            _count(intact, lambda record: _at_rail(record) or _large(record)),
        ),
        (
            "sensor faults: error ≤ 1 %, or ≤ 1.5 × that of the better of frozen model and last estimate; named within "
            "0.5 s of motion; both",
            "all",
            "; ".join(
                _count(sensors, holds)
                for holds in (_in_order, _named, lambda record: _in_order(record) and _named(record))
            ),
        ),
        (
            "sensor faults: mean error during the fault over that of the better one, median / worst",
            "≤ 1.5",
            _percentiles(_numbers(record.get("sensor_ratio") for record in sensors), 50, 100, digits=2),
        ),
        (
            f"knock: worst half second over that of the frozen model, median / worst of {len(knocks)} runs",
            "≤ 1.1",
            _percentiles(ratio, 50, 100, digits=2),
        ),
        (
            f"step of the gain by 6 % at once: first second, median / 95 % of {len(steps)} runs of 3 to 12 %, each "
            "error times 6 % over its step (as drawn)",
            "≤ 0.3 / 0.8 %",
            f"{_percentiles(first * STEP_PCT / size_pct, 50, 95)} % ({_percentiles(first, 50, 95)} %)",
        ),
        (
            "wrong readings (spikes and bursts), and jumps that were believed in these runs",
            "≤ 1 in 1000",
            _false_beliefs(intact),
        ),
        (
            f"settled: median over {len(intact)} runs with an intact stage; twenty scenarios no worse than before",
            "≤ 0.030 %",
            f"{_percentiles(settled, 50)} %; for the scenarios run `dehyst scenarios`",
        ),
        (
            "healthy runs: false `trouble`, counted until the event",
            "0 in 8 h",
            f"{false} in {hours:.2f} h of simulated time",
        ),
    ]
    return markdown(GOALS_HEAD, rows)


def _false_beliefs(intact: Sequence[Record]) -> str:
    rates = {"spikes": SPIKES_HZ, "bursts": BURSTS_HZ}
    wrong = [record for record in intact if record["class"] in rates and "jumps" in record]
    if not wrong:
        return "not measured by these runs"
    readings = sum(rates[record["class"]] * record["event"]["over_s"] for record in wrong)
    return f"{sum(record['jumps'] for record in wrong)} in some {readings:.0f} of {len(wrong)} runs"


HEAD = (
    "event", "runs", "failed", "end at a rail", "above 5 % for longer than 0.1 s", "first second, median / 95 %",
    "settled, median / 95 %", "frozen model settled, median", "worst half second over frozen, median / worst",
    "fault named within 0.5 s of motion", "error ≤ 1 % or ≤ 1.5 × the better",
    "error over the better, median / worst", "`trouble` with an intact stage",
)  # fmt: skip


def row(name: str, all_records: Sequence[Record]) -> tuple[str, ...]:
    """The cells of a class of events."""
    intact, sensors = _parts(all_records)
    records = [*intact, *sensors]
    failed = str(len(all_records) - len(records))
    if not records:
        return (name, str(len(all_records)), failed, *["-"] * (len(HEAD) - 3))
    return (
        name,
        str(len(all_records)),
        failed,
        str(sum(map(_at_rail, records))),
        str(sum(map(_large, records))),
        _percentiles(_of(records, "adaptive", "first_second_pct"), 50, 95),
        _percentiles(_of(records, "adaptive", "settled_pct"), 50, 95),
        _percentiles(_of(records, "frozen", "settled_pct"), 50),
        _percentiles(_numbers(record["worst_ratio"] for record in records), 50, 100, digits=2),
        _count(sensors, _named),
        _count(sensors, _in_order),
        _percentiles(_numbers(record.get("sensor_ratio") for record in sensors), 50, 100, digits=2),
        str(sum(bool(record["troubles"]) for record in intact)) if intact else "-",
    )


def by_class(records: Sequence[Record]) -> str:
    """Markdown: one row for each class of events."""
    intact, sensors = _parts(records)
    classes = ((name, [record for record in records if record.get("class") == name]) for name in CLASSES)
    groups = (("**stage intact**", intact), ("**sensor faults**", sensors), ("**all**", list(records)))
    return markdown(HEAD, [row(name, part) for name, part in (*classes, *groups) if part])


def table(records: Sequence[Record]) -> str:
    """Both tables, and the number of runs."""
    failed = sum("failed" in record for record in records)
    return f"{goals(records)}\n\n{by_class(records)}\n\nruns: {len(records)}, of which {failed} failed"


def line(records: Sequence[Record]) -> str:
    """All runs in one line. Settled: over the runs with a working sensor.

    Without a sensor, the error may exceed 5 % where the frozen model's does; so those runs have a limit of their own.
    """
    intact, sensors = _parts(records)
    done = [*intact, *sensors]
    failed = len(records) - len(done)
    settled = _percentiles(_of(intact, "adaptive", "settled_pct"), 50)
    parts = [
        f"{len(records)} runs",
        *([f"{failed} FAILED"] if failed else []),
        f"{sum(map(_at_rail, done))} at a rail",
        f"{_count(intact, _large)} with an intact stage above 5 % of range for longer than {LARGE_S:g} s",
        f"{_count(sensors, _named)} sensor faults named, {_count(sensors, _in_order)} within the error allowed",
        f"settled {settled} % (median)",
    ]
    return "\n".join(
        [*(told(record) for record in records if "failed" in record), "foreign stages: " + ", ".join(parts)]
    )


def healthy_table(records: Sequence[Record]) -> str:
    """What healthy runs came to, and below it each run that failed, or has a trouble or a large error."""
    ended = [record for record in records if "failed" not in record]
    names = Counter(trouble["name"] for record in ended for trouble in record["troubles"])
    large = sum(record["figures"]["large_s"] > LARGE_S for record in ended)
    blocks = ", ".join(str(block) for block in sorted({record["block"] for record in records}))
    said = (
        f"healthy: {len(records)} stages, {len(records) - len(ended)} failed, {_hours(ended):.2f} h; false troubles "
        f"{names.total()} ({', '.join(f'{name} {count}' for name, count in sorted(names.items())) or 'none'}); {large} "
        f"above 5 % for longer than {LARGE_S:g} s; error after the start, median / 95 %: "
        f"{_percentiles(_numbers(record['mean_pct'] for record in ended), 50, 95)}; answers know all samples but the "
        f"last {blocks}"
    )
    return "\n".join([said, *(told(record) for record in records if _notable(record))])


def _rate_Hz(record: Record) -> int:
    return round(1.0 / record["stage"]["dt_s"])


def _notable(record: Record) -> bool:
    return "failed" in record or bool(record["troubles"]) or record["figures"]["large_s"] > LARGE_S


def controllers_table(records: Sequence[Record]) -> str:
    """Median and worst of all stages, by controller and age."""
    by_row: dict[tuple[str, int], list[list[float]]] = {}
    for record in records:
        for one in record.get("controllers", ()):
            errors = [one["moving_pct"], one["first_second_pct"], *one["lines_pct"]]
            by_row.setdefault((one["way"], one["age"]), []).append(errors)
    rows = [
        (
            controllers.WAYS[way], str(age),
            *(f"{np.median(column):.3f} / {max(column):.3f}" if np.isfinite(column).all() else "-"
              for column in zip(*errors, strict=True)),
        )
        for (way, age), errors in by_row.items()
    ]  # fmt: skip
    stages = sum("controllers" in record for record in records)
    return f"{stages} stages, median / worst, % of the range:\n\n{markdown(controllers.HEAD, rows)}"


def told(record: Record) -> str:
    """A run in one line."""
    first = f"seed {record['seed']} "
    if "failed" in record:
        return f"{first}{record.get('class', record.get('motion', ''))}: {why_failed(record)}"
    if "ages" in record:
        return f"{first}{record['hysteresis']}: {len(record['controllers'])} rows, {record['cpu_s']:.0f} s"
    first += f"{record['stage']['hysteresis']} {_rate_Hz(record)} Hz, "
    if "motion" in record:
        first += foreign_motions.told(record)
        marks = [f"TROUBLE {trouble['name']} at {trouble['at_s']:.2f} s" for trouble in record["troubles"]]
    elif record["class"] == HEALTHY:
        first += f"{record['simulated_s']:.0f} s: error {record['mean_pct']:.3f}"
        large_s = record["figures"]["large_s"]
        marks = [f"TROUBLE {trouble['name']} at {trouble['named_s']:.2f} s" for trouble in record["troubles"]]
        marks += [f"LARGE for {large_s:.2f} s"] if large_s > LARGE_S else []
    else:
        adaptive = record["adaptive"]
        first += f"{record['text']}: first {adaptive['first_second_pct']:.3f}, settled {adaptive['settled_pct']:.3f}"
        large = f"LARGE for {adaptive['large_s']:.2f} s from {adaptive['large_at_s'] or 0.0:+.2f} s"
        unnamed = record["category"] == SENSOR and not _named(record)
        seen = {"AT A RAIL": _at_rail(record), large: _large(record), "NOT NAMED": unnamed}
        marks = [mark for mark, holds in seen.items() if holds]
    return f"{first}, {record['cpu_s']:.1f} s {', '.join(marks)}".rstrip()


# ---- command line


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, or read runs that are done; prints the tables or the line. Returns 1 where a run failed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.foreign", description=__doc__)
    parser.add_argument("--runs", type=int, default=40, metavar="N", help="how many seeds (40)")
    parser.add_argument("--first-seed", type=int, default=0, metavar="S", help="the first of them (0)")
    parser.add_argument("--jobs", type=int, metavar="N", help="processes at a time (1; 2 with --line)")
    parser.add_argument(
        "--json", type=Path, metavar="F", help="add a line for each run, as it ends; go on where the file ends"
    )
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="EVENT", help=f"classes of events: {', '.join(CLASSES)}"
    )
    parser.add_argument(
        "--after", type=float, metavar="S",
        help=f"closed loop after the event, s ({AFTER_S:g}), or from {foreign_motions.FROM_S:g} s of a motion on "
        f"({foreign_motions.AFTER_S:g})",
    )  # fmt: skip
    parser.add_argument("--poor", action="store_true", help="--motions: identify from 2 s of half the stroke")
    parser.add_argument(
        "--true-length", action="store_true", help="--motions: hold for an hour, stand for a night; takes hours"
    )
    parser.add_argument(
        "--repetition", action="store_true", help="--motions: also followed with and without [axis.repetition]"
    )
    parser.add_argument(
        "--block", type=int, default=5, metavar="N",
        help="samples per query and snapshot of --healthy (5): fewer queries cost less, and answers are older",
    )  # fmt: skip
    only = parser.add_mutually_exclusive_group()
    only.add_argument(
        "--healthy", type=float, metavar="HOURS",
        help="run stages on which nothing happens until --json holds so many hours of simulated time",
    )  # fmt: skip
    only.add_argument(
        "--motions", metavar="NAME[,NAME]",
        help=f"run motions on stages on which nothing happens: {', '.join(MOTIONS)}; raster:10 is one of 10 Hz",
    )  # fmt: skip
    only.add_argument(
        "--controllers", nargs="+", type=int, metavar="AGE",
        help="run the corrections beside other controllers, with readings so many samples old",
    )  # fmt: skip
    only.add_argument("--line", action="store_true", help=f"run {len(LINE)} fixed stages and print one line")
    only.add_argument("--table", nargs="+", type=Path, metavar="F", help="print the tables of these files; run nothing")
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.only if name not in CLASSES]:
        parser.error(f"--only: got {unknown[0]!r}, expected some of {', '.join(CLASSES)}")
    jobs = given.jobs if given.jobs is not None else 2 if given.line else 1
    if given.runs < 1 or jobs < 1 or given.first_seed < 0:
        parser.error("--runs, --jobs: expected at least 1; --first-seed: expected 0 or more")
    if any(age < 1 for age in given.controllers or ()):
        parser.error(f"--controllers: got {min(given.controllers)}, expected ages of 1 sample or more")
    given.motions = given.motions.split(",") if given.motions is not None else []
    for name in given.motions:
        try:
            motion(name)
        except (KeyError, ValueError):
            parser.error(f"--motions: got {name!r}, expected some of {', '.join(MOTIONS)}, or such as raster:10")
    if given.after is None:
        given.after = foreign_motions.AFTER_S if given.motions else AFTER_S
    if given.after < 4.0:
        parser.error(f"--after: got {given.after:g} s, expected 4 s or more")
    if given.healthy is not None and not 0.0 < given.healthy <= 1e4:
        parser.error(f"--healthy: got {given.healthy:g}, expected hours above 0 and up to 10000")
    if not 1 <= given.block <= 512:
        parser.error(f"--block: got {given.block}, expected 1 to 512")
    records = read_lines(given.table) if given.table else _carry_out(given, jobs)
    print(line(records) if given.line else tables(records))
    return 1 if any("failed" in record for record in records) else 0


def tables(records: Sequence[Record]) -> str:
    """The tables of all kinds of runs among the records."""
    parts: dict[Callable[[Sequence[Record]], str], list[Record]] = {
        table: [],
        healthy_table: [],
        foreign_motions.table: [],
        controllers_table: [],
    }
    for record in records:
        healthy = record.get("class") == HEALTHY
        made = foreign_motions.table if "motion" in record else controllers_table if "ages" in record else table
        parts[healthy_table if healthy else made].append(record)
    return "\n\n".join(made(part) for made, part in parts.items() if part) or table([])


def _carry_out(given: argparse.Namespace, jobs: int) -> list[Record]:
    """The runs that are asked for, after those that the file holds already."""
    if given.line:
        print(
            f"{len(LINE)} runs on simulated stages that the service was not built with, half a minute", file=sys.stderr
        )
        return list(run_all(event_runs(LINE), jobs))
    records = read_lines([given.json]) if given.json and given.json.exists() else []
    if given.healthy is not None:
        plan = healthy_runs(given.healthy, given.first_seed, given.block, records)
    elif given.motions:
        plan = motion_runs(given)
    else:
        seeds = range(given.first_seed, given.first_seed + given.runs)
        classes = given.only or list(CLASSES)
        plan = event_runs([(classes[seed % len(classes)], seed) for seed in seeds], given.after)
        if given.controllers:
            ages = given.controllers
            plan = [(functools.partial(run_controllers, seed, ages), {"seed": seed, "ages": ages}) for seed in seeds]
    plan = [(run, named) for run, named in plan if not any(named.items() <= record.items() for record in records)]
    for k, record in enumerate(run_all(plan, jobs), 1):
        records.append(record)
        print(f"[{k}/{len(plan)}] {told(record)}", file=sys.stderr, flush=True)
        add_line(given.json, record)
    return records


if __name__ == "__main__":
    raise SystemExit(main())
