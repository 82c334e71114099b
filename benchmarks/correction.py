"""What the guarded corrections come to on stages of others, beside their rivals, all in one run and side by side.

``python -m benchmarks.correction --first 1 --stages 2 [--json out/correction.jsonl]``. Each stage
(``tests/foreign/plants.py``) is identified; then the same motion, which does not repeat, is followed by five
controllers at each age of the readings, and something happens. ``--table FILE`` prints the tables of finished runs.
Errors are mean absolute errors of the true position in percent of the commanded range. The age counts for the
correction and for the learner alike: age 1 is the reading of the sample before.

``--cases raster`` follows triangles of 5, 15 and 30 Hz, 20 lines each, from a rest, with readings of each age; errors
are means of a line.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.records import Record, recorded
from dehyst.adaptive.types import FloatArray
from dehyst.lab.rehearsal import RehearsalConfig, identify
from dehyst.lab.rehearsal.controllers import COUNT_S, EVENT_S, SECONDS, SHOWN, Course, line_errors_pct
from dehyst.lab.rehearsal.disturbance import Event
from dehyst.lab.rehearsal.reference import Motion
from dehyst.service.reports.tables import markdown
from tests.foreign.motions import motion
from tests.foreign.plants import Traits, random_plant

#: Controllers, see `lab.rehearsal.controllers`.
WAYS: Final = ("alone", "corrected", "frozen+I", "frozen", "I")
AGES: Final = (1, 5, 20)
#: What happens: event, controllers and ages.
CASES: Final = {
    "gain": (WAYS, AGES),
    "payload": (("alone", "corrected", "frozen+I"), (1, 20)),
    "rest": (("alone", "corrected"), (1, 5)),
    "stuck": (("alone", "corrected", "frozen+I"), (5,)),
    "sensor_gain": (("alone", "corrected"), (5,)),
    "drift": (("alone", "corrected"), (5,)),
}  # fmt: skip
#: Rasters: case and controllers.
RASTER: Final = "raster"
RASTERS_HZ: Final = (5.0, 15.0, 30.0)
RASTER_WAYS: Final = ("repetition", "iterative", "frozen+iterative", "alone", "corrected", "frozen+I", "I")
#: A stage at rest rests from here on, and its jitter counts so much later, s.
REST_S: Final = 3.0
SETTLED_S: Final = 1.0
#: A drifting sensor, share of the range a second.
DRIFT_PER_S: Final = 0.01
#: Step of the gain; the frequency that is stated where a stage has no mode, Hz, and as a share of that of its first
#: mode, which a payload of twice the moved mass leaves of it.
STEP: Final = 0.06
NO_MODE_HZ: Final = 300.0
OF_MODE: Final = 1.0 / math.sqrt(3.0)
#: Faster stages are left out: a run of them takes minutes.
FASTEST_S: Final = 4e-4
LARGE_PCT: Final = 5.0


@dataclass(frozen=True, slots=True)
class ForeignCourse(Course):
    """A stage of others. ``name`` : of its hysteresis."""

    name: str = ""

    def at_rest(self) -> ForeignCourse:
        """The same motion, which comes to rest with a smooth ramp after `REST_S`."""
        dt_s, y = self.known.dt_s, self.wanted.y_um
        t_s = np.arange(y.size) * dt_s - REST_S
        q = np.clip(1.0 - t_s / 0.3, 0.0, 1.0)
        weight = q**4 * (35.0 - 84.0 * q + 70.0 * q**2 - 20.0 * q**3)
        level = float(y[round(REST_S / dt_s)])
        moved = level + weight * (y - level)
        speed = np.gradient(moved, dt_s)
        return replace(self, wanted=Motion(moved, speed, np.gradient(speed, dt_s)))

    def event(self, name: str) -> Event:
        """What happens in the case ``name``."""
        rng = np.random.default_rng([self.seed, 51])
        sign = float(rng.choice([-1.0, 1.0]))
        size = {"gain": STEP * sign, "payload": float(rng.uniform(1.0, 2.0)), "sensor_gain": 1.0 + 0.6 * sign}
        kind = "none" if name in ("rest", "drift", RASTER) else name
        over_s = SECONDS - EVENT_S if name in ("stuck", "sensor_gain") else 0.0
        return Event(name, kind, EVENT_S, size.get(name, 0.0), over_s, self.seed)


def course_of(seed: int) -> ForeignCourse:
    """The stage of ``seed``, and a motion of its own."""
    factory = random_plant(seed)
    traits = factory.traits
    low_V, high_V = traits.excite_V
    known = identify(factory, RehearsalConfig(excite_low_V=low_V, excite_high_V=high_V, compete=()))
    return ForeignCourse.of(factory, known, low_V, mode_of(traits), seed, name=traits.hysteresis)


def mode_of(traits: Traits) -> float:
    """The frequency that is stated of a stage as the lowest at which it rings, Hz."""
    return OF_MODE * traits.modes[0][0] if traits.modes else NO_MODE_HZ


def follow(course: ForeignCourse, way: str, age: int, case: str) -> Record:
    """(n,) true positions, µm, and corrections, V, of a run, and the counts of its correction."""
    got, following, axis = course.follow(way, age, course.event(case), DRIFT_PER_S * (case == "drift"))
    correcting = None if following is None else following.correcting
    counts: Record = {}
    if correcting is not None and correcting.correction is not None:
        integral = correcting.correction
        counts = {"halved": integral.halved, "doubted": integral.doubted, "gain_per_s": integral.loop.gain_per_s}
    if correcting is not None and correcting.repetition is not None:
        counts |= {"repetition_halved": correcting.repetition.halved, "period": correcting.repetition.period}
    added_V = np.zeros(got.u_V.size) if following is None or not following.added_V else np.array(following.added_V)
    return {"true_um": got.true_um, "added_V": added_V, "trouble": axis.newest.trouble, **counts}


def figures(course: ForeignCourse, got: Record) -> Record:
    """Errors in percent of the range, as JSON values."""
    dt_s, limits = course.known.dt_s, course.known.limits
    error = 100.0 / course.range_um * np.abs(course.wanted.y_um - got["true_um"])
    begin, at, second = round(COUNT_S / dt_s), round(EVENT_S / dt_s), round(1.0 / dt_s)
    settled = got["true_um"][round((REST_S + SETTLED_S) / dt_s) :]
    added = 100.0 / (limits.u_max_V - limits.u_min_V) * np.abs(got["added_V"])
    return {
        "before": float(error[begin:at].mean()), "first": float(error[at : at + second].mean()),
        "after": float(error[at:].mean()), "large_s": float((error[begin:] > LARGE_PCT).sum() * dt_s),
        # The slow part, creep and drift, is no jitter.
        "jitter": float(np.std(np.diff(settled)) / course.range_um * 100.0),
        "carried": float(added[begin:at].mean()), "carried_after": float(added[at + second :].mean()),
        **{key: got[key] for key in ("halved", "doubted", "gain_per_s", "trouble") if key in got},
    }  # fmt: skip


def lines(course: ForeignCourse, got: Record) -> Record:
    """Mean error of each line in percent of the range, as JSON values."""
    errors = line_errors_pct(course.wanted.y_um, got["true_um"], course.raster_Hz, course.known.dt_s)
    counts = {key: got[key] for key in ("halved", "repetition_halved", "period", "trouble") if key in got}
    return {"lines": errors.tolist(), **counts}


def run_one(
    course: ForeignCourse, way: str, age: int, case: str, measure: Callable[[ForeignCourse, Record], Record]
) -> Record:
    """One run by its measures; one that raises has its traceback, and the others go on."""
    record: Record = {
        "seed": course.seed, "case": case, "way": way, "age": age, "hysteresis": course.name,
        "dt_s": course.known.dt_s,
    }  # fmt: skip
    with recorded(record):
        record |= measure(course, follow(course, way, age, case))
    return record


def run_rasters(course: ForeignCourse, ages: Sequence[int] = AGES, ways: Sequence[str] = RASTER_WAYS) -> list[Record]:
    """All runs of a stage along rasters; a run that raises has its traceback."""
    records = []
    for frequency_Hz, age, way in itertools.product(RASTERS_HZ, ages, ways):
        there = course.raster(frequency_Hz, motion(f"raster:{frequency_Hz}"))
        more = {"frequency_Hz": frequency_Hz, "mode_Hz": course.mode_Hz}
        records.append(run_one(there, way, age, RASTER, lines) | more)
    return records


def run_stage(course: ForeignCourse, cases: Sequence[str] = tuple(CASES), chosen: Sequence[str] = WAYS) -> list[Record]:
    """All runs of a stage by the ``chosen`` controllers; a run that raises has its traceback."""
    records = []
    for case in cases:
        ways, ages = CASES[case]
        there = course.at_rest() if case == "rest" else course
        for age in ages:
            records += [run_one(there, way, age, case, figures) for way in ways if way in chosen]
    return records


# ---- tables


def _of(records: Sequence[Record], case: str, way: str, age: int, name: str) -> FloatArray:
    """(stages,) figures, in the order of the seeds."""
    found = {r["seed"]: r[name] for r in records if (r["case"], r["way"], r["age"]) == (case, way, age)}
    return np.array([found[seed] for seed in sorted(found)], dtype=np.float64)


def _over(records: Sequence[Record], case: str, way: str, age: int, name: str) -> str:
    """The figure with the correction over that of ``way``, median and worst."""
    ours, theirs = _of(records, case, "corrected", age, name), _of(records, case, way, age, name)
    return _text(ours / theirs, 2) if ours.size == theirs.size else "-"


def _text(values: FloatArray, digits: int = 3) -> str:
    """Median and worst."""
    return f"{np.median(values):.{digits}f} / {values.max():.{digits}f}" if values.size else "-"


def raster_table(records: Sequence[Record]) -> str:
    """Markdown: errors of the lines `SHOWN` by frequency, age and controller, and what the goals ask of them."""
    stages = len({record["seed"] for record in records})
    rows, goals = [], []
    for frequency_Hz, age in itertools.product(RASTERS_HZ, AGES):
        found = {
            way: np.array([r["lines"] for r in sorted(records, key=lambda r: int(r["seed"]))
                           if (r["frequency_Hz"], r["age"], r["way"]) == (frequency_Hz, age, way)])
            for way in RASTER_WAYS
        }  # fmt: skip
        for way, errors in found.items():
            if errors.size:
                cells = (_text(errors[:, line - 1]) for line in SHOWN)
                rows.append((f"{frequency_Hz:g}", str(age), way, *cells))
        ours, rival, harder = (found[way] for way in ("repetition", "iterative", "frozen+iterative"))
        if ours.size and rival.size:
            first, tenth = ours[:, 0] / rival[:, 0], ours[:, 9] / rival[:, 9]
            over_frozen = _text(ours[:, 9] / harder[:, 9], 2) if harder.size else "-"
            goals.append(
                (f"{frequency_Hz:g}", str(age), _text(tenth, 2), f"{int((tenth <= 1.0).sum())} of {stages}",
                 over_frozen, _text(first, 2), f"{int((first <= 0.2).sum())} of {stages}")
            )  # fmt: skip
    shown = (f"line {line}" for line in SHOWN)
    head = ("Hz", "age", "line 10 over iterative", "at most 1", "over frozen+iterative", "line 1 over iterative",
            "at most 0.2")  # fmt: skip
    return "\n\n".join(
        (f"Rasters on {stages} stages, median / worst, % of the range:", markdown(("Hz", "age", "way", *shown), rows),
         "Repetition over its rivals, median / worst:", markdown(head, goals))
    )  # fmt: skip


def tables(records: Sequence[Record]) -> str:
    """Markdown: errors by controller and age, and what happens."""
    records = [record for record in records if "failed" not in record]
    rasters = [record for record in records if record["case"] == RASTER]
    if rasters:
        records = [record for record in records if record["case"] != RASTER]
        return raster_table(rasters) + (f"\n\n{tables(records)}" if records else "")
    stages = len({record["seed"] for record in records})
    rows = [
        (
            str(age), *(_text(_of(records, "gain", way, age, "before")) for way in WAYS),
            *(_over(records, "gain", way, age, "before") for way in ("frozen+I", "alone")),
        )
        for age in AGES
    ]  # fmt: skip
    head = ("age, samples", *WAYS, "corrected over frozen+I", "corrected over alone")
    parts = [f"{stages} stages, median / worst, % of the range. Motion that does not repeat:", markdown(head, rows)]
    rows = [
        (str(age), *(_text(_of(records, "gain", way, age, "first")) for way in WAYS),
         _text(_of(records, "gain", "corrected", age, "carried")),
         _text(_of(records, "gain", "corrected", age, "carried_after")))
        for age in AGES
    ]  # fmt: skip
    parts += [
        f"First second after a step of the gain by ±{100.0 * STEP:g} %; what the correction carries, % of the drive:",
        markdown(("age, samples", *WAYS, "carried before", "carried later"), rows),
    ]
    names = ("alone", "corrected", "frozen+I")
    rows = [
        (case, str(age), *(_text(_of(records, case, way, age, "after")) for way in names),
         *(str(int((_of(records, case, way, age, "large_s") > 0.1).sum())) for way in names))
        for case in ("payload", "stuck", "sensor_gain", "drift") if any(r["case"] == case for r in records)
        for age in CASES[case][1]
    ]  # fmt: skip
    large = tuple(f"{way}: runs above {LARGE_PCT:g} % for 0.1 s" for way in names)
    parts += ["After the event, to the end of the run:", markdown(("event", "age", *names, *large), rows)]
    rows = [
        (str(age), *(_text(_of(records, "rest", way, age, "jitter"), 4) for way in names),
         _over(records, "rest", "alone", age, "jitter"))
        for age in CASES["rest"][1]
    ]  # fmt: skip
    parts += [
        "Jitter at rest, standard deviation of the change from sample to sample:",
        markdown(("age", *names, "corrected over alone"), rows),
    ]
    halved = sum(record.get("halved", 0) > 0 for record in records if record["way"] == "corrected")
    parts.append(f"Corrected runs in which an oscillation halved the gain: {halved} of "
                 f"{sum(record['way'] == 'corrected' for record in records)}.")  # fmt: skip
    return "\n\n".join(parts)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=1, help="first seed (%(default)s)")
    parser.add_argument("--stages", type=int, default=2, help="number of stages (%(default)s)")
    parser.add_argument("--cases", nargs="+", choices=(*CASES, RASTER), default=tuple(CASES),
                        help="what happens, or rasters (all but rasters)")  # fmt: skip
    parser.add_argument(
        "--ages", nargs="+", type=int, choices=AGES, default=AGES, help="of the readings, rasters (all)"
    )
    every = tuple(dict.fromkeys((*WAYS, *RASTER_WAYS)))
    parser.add_argument("--ways", nargs="+", choices=every, default=every, help="controllers (all)")
    parser.add_argument("--json", type=Path, help="add the runs to this file, one a line")
    parser.add_argument("--table", type=Path, help="print the tables of the runs in this file")
    args = parser.parse_args()
    records: list[Record] = []
    if args.table is not None:
        records = [json.loads(line) for line in args.table.read_text(encoding="utf-8").splitlines()]
    else:
        seeds = (seed for seed in itertools.count(args.first) if random_plant(seed).traits.dt_s > FASTEST_S)
        for seed in itertools.islice(seeds, args.stages):
            begin = time.process_time()
            course = course_of(seed)
            new = run_stage(course, [case for case in args.cases if case != RASTER], args.ways)
            of_rasters = [way for way in RASTER_WAYS if way in args.ways]
            new += run_rasters(course, args.ages, of_rasters) if RASTER in args.cases else []
            records += new
            failed = sum("failed" in record for record in new)
            print(f"stage {seed}: {time.process_time() - begin:.0f} s, {failed} failed", file=sys.stderr, flush=True)
            if args.json is not None:
                with args.json.open("a", encoding="utf-8") as out:
                    out.writelines(json.dumps(record) + "\n" for record in new)
    print(tables(records))


if __name__ == "__main__":
    main()
