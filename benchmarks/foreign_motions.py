"""How the service follows motions that users make (``tests/foreign/motions.py``) on stages on which nothing happens.

``python -m benchmarks.foreign --motions raster:10,tone:50 --runs 40`` runs them. Errors are mean absolute errors in
percent of the commanded range, from ``FROM_S`` after the begin of the motion on.

With ``--repetition`` a follower with ``[axis.correction]`` and ``[axis.repetition]`` follows each motion too, beside
the same follower without them, with readings ``AGE`` samples old; a second table compares them.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from benchmarks.correction import mode_of
from benchmarks.records import Record, recorded
from dehyst.lab.rehearsal import Event, Motion, RehearsalConfig, identify, run_event
from dehyst.lab.rehearsal.controllers import Course
from dehyst.lab.rehearsal.outcome import moving_mean
from dehyst.lab.rehearsal.reference import ReferenceRequest
from dehyst.lab.rehearsal.runs import times
from dehyst.service.protocol.query import BLENDED, OUTSIDE_DOMAIN, STAND_IN
from dehyst.service.reports.tables import json_form, markdown
from tests.foreign.motions import MOTIONS, motion
from tests.foreign.plants import Traits, random_plant

#: Recordings to identify from: 10 s of the whole stroke, or 2 s of its lower half. The frequency of both is 3 Hz at
#: first and falls. After a poor one the motion stays within the half that is known: the axis refuses what is beyond.
RECORDINGS: Final = ("full", "poor")
POOR_S, POOR_STROKE = 2.0, 0.5
#: The motions lie within these shares of the identified range.
BAND: Final = (0.05, 0.95)
#: From here on errors count, s after the begin of the motion (after a rest: after its end), and for how long, s.
FROM_S, AFTER_S = 5.0, 6.0
#: A run is cut to so many samples, but errors count for at least so many seconds.
MOST_SAMPLES, LEAST_S = 60_000, 2.0
#: Rests: in the short runs, s and samples at most; true lengths, s.
STILL_S, STILL_SAMPLES = 30.0, 30_000
TRUE_S: Final = {"hold": 3600.0, "night": 8 * 3600.0}
#: Motions from this frequency on need this sample rate, Hz; tones from this one on a first mode this high, or none.
FAST_HZ, FAST_RATE_HZ = 20.0, 1000.0
FAST_TONE_HZ, FAST_TONE_MODE_HZ = 50.0, 300.0
#: Learning is compared with not learning over every window of this length, s; with errors of at least this, percent.
WINDOW_S, FLOOR_PCT = 2.0, 0.02
#: Readings of the followers, samples old.
AGE: Final = 5
#: Controllers that follow, see `lab.rehearsal.controllers`, and what their errors are called.
FOLLOWED: Final = {"alone": "followed_pct", "repetition": "repeated_pct"}


@dataclass(frozen=True, slots=True)
class Goal:
    """Limits of the error, percent: median and worst of the runs; of learning over not learning in each run."""

    median_pct: float = math.inf
    worst_pct: float = math.inf
    over_frozen: float = math.inf
    two_seconds: float = 1.1

    def __str__(self) -> str:
        limits = (
            ("median", self.median_pct, " %"), ("worst", self.worst_pct, " %"), ("over frozen", self.over_frozen, ""),
            ("two seconds", self.two_seconds, ""),
        )  # fmt: skip
        return ", ".join(f"{name} ≤ {limit:g}{unit}" for name, limit, unit in limits if math.isfinite(limit))


_RASTER: Final = Goal(0.15, 0.5, 1.05)
GOALS: Final = {
    "raster:5": _RASTER, "raster:10": _RASTER, "raster:20": _RASTER, "tone:50": Goal(0.5), "tone:100": Goal(1.5),
}  # fmt: skip


def fits(name: str, seed: int, traits: Traits) -> bool:
    """Whether the stage of a seed can be asked for the motion."""
    frequency_Hz = motion(name).drawn_Hz(seed)
    if frequency_Hz >= FAST_HZ and 1.0 / traits.dt_s < FAST_RATE_HZ * (1.0 - 1e-9):
        return False
    slow = bool(traits.modes) and traits.modes[0][0] < FAST_TONE_MODE_HZ
    return not (slow and name.partition(":")[0] == "tone" and frequency_Hz >= FAST_TONE_HZ)


def planned(names: Sequence[str], first_seed: int, runs: int) -> list[tuple[str, int]]:
    """(motion, seed) of so many runs each, with the first seeds whose stages fit."""
    fitting = {name: _fitting(name, first_seed) for name in names}
    return [(name, next(seeds)) for _ in range(runs) for name, seeds in fitting.items()]


def _fitting(name: str, first_seed: int) -> Iterator[int]:
    return (seed for seed in itertools.count(first_seed) if fits(name, seed, random_plant(seed).traits))


def run_motion(
    name: str, seed: int, recording: str = "full", after_s: float = AFTER_S, true_length: bool = False,
    repetition: bool = False,
) -> Record:  # fmt: skip
    """One motion on one stage, learning and frozen, as JSON values. If it raises, the record holds the traceback.

    repetition : also followed, with and without the repetition.
    """
    record: Record = {"seed": seed, "recording": recording, "motion": name}
    with recorded(record):
        factory = random_plant(seed)
        traits = factory.traits
        dt_s = traits.dt_s
        maker = motion(name)
        if maker.rests:
            still_s = TRUE_S[maker.rests] if true_length else min(STILL_S, STILL_SAMPLES * dt_s)
            maker = replace(maker, still_s=still_s)
        from_s = maker.begin_s(seed) + FROM_S
        cut_s = math.inf if true_length else max(MOST_SAMPLES * dt_s - from_s, LEAST_S)
        duration_s = from_s + min(after_s, cut_s)
        low_V, high_V = traits.excite_V
        poor = recording == "poor"
        config = RehearsalConfig(
            identify_s=POOR_S if poor else 10.0,
            excite_low_V=low_V,
            excite_high_V=low_V + POOR_STROKE * (high_V - low_V) if poor else high_V,
            band=BAND,
            reference=maker,
        )
        record |= {"frequency_Hz": maker.drawn_Hz(seed), "still_s": maker.still_s, "stage": traits.summary()}
        known = identify(factory, config)
        run = run_event(factory, known, config, Event("none", "none", duration_s - config.after_s), seed)
        one, other = (
            100.0 / run.range_um * np.abs(course.wanted_um - course.true_um) for course in (run.adaptive, run.frozen)
        )
        part = slice(round(from_s / dt_s), None)
        window = round(WINDOW_S / dt_s)
        ratio = moving_mean(one, window) / np.maximum(moving_mean(other, window), FLOOR_PCT)
        names = run.adaptive.verdicts
        counts = [Counter(names[code] for code in run.adaptive.verdict[p].tolist()) for p in (slice(None), part)]
        troubles = [
            {"name": t.name, "at_s": t.named_s + run.event.at_s, "until_s": t.until_s + run.event.at_s}
            for t in run.outcome.troubles
        ]
        record |= json_form(
            {
                "heldout_mae_pct": known.heldout_mae_pct,
                "range_um": run.range_um,
                "simulated_s": one.size * dt_s,
                "from_s": from_s,
                "adaptive_pct": float(one[part].mean()),
                "frozen_pct": float(other[part].mean()),
                "two_seconds": float(ratio.max()),
                "two_seconds_at_s": float(np.argmax(ratio) * dt_s),
                "troubles": troubles,
                "verdicts": dict(counts[0]),
                "verdicts_after": dict(counts[1]),
                "outside": float(np.mean(run.adaptive.flags[part] & OUTSIDE_DOMAIN > 0)),
                "stand_in": float(np.mean(run.adaptive.flags[part] & (BLENDED | STAND_IN) > 0)),
                "large_s": run.outcome.adaptive.large_s,
                "ends_at_rail": run.outcome.adaptive.ends_at_rail,
            }
        )
        if repetition:
            span, n = known.high_um - known.low_um, one.size
            wish = ReferenceRequest(
                known.rest_um, known.low_um + BAND[0] * span, known.low_um + BAND[1] * span, n * dt_s, seed
            )
            wanted = maker(wish)(times(n, dt_s))
            clipped = np.clip(wanted.y_um, known.low_um, known.high_um)
            course = Course(
                seed, factory, low_V, mode_of(traits), known, Motion(clipped, *wanted[1:]), run.range_um
            )  # fmt: skip
            for way, key in FOLLOWED.items():
                got = course.follow(way, AGE, Event("none", "none", from_s))[0]
                record[key] = float(100.0 / run.range_um * np.abs(clipped - got.true_um)[part].mean())
    return record


# ---- the tables


HEAD = (
    "motion", "runs", "failed", "learning, median / 95 % / worst", "frozen, median", "worst over frozen",
    "worst two seconds over frozen", "runs with `trouble`", "samples learnt (passed the gates)",
    "answers outside the domain / of a stand-in", "goal", "met",
)  # fmt: skip


def _values(records: Iterable[Record], name: str) -> np.ndarray:
    """(n,) numbers; JSON has null for values that are not finite."""
    return np.array([np.nan if record[name] is None else record[name] for record in records], dtype=np.float64)


def row(name: str, records: Sequence[Record]) -> tuple[str, ...]:
    """The cells of a motion."""
    goal = GOALS.get(name, Goal())
    done = [record for record in records if "failed" not in record]
    first = (name, str(len(records)), str(len(records) - len(done)))
    if not done:
        return (*first, *["-"] * (len(HEAD) - 5), str(goal), "-")
    adaptive, frozen, two = (_values(done, key) for key in ("adaptive_pct", "frozen_pct", "two_seconds"))
    over = adaptive / frozen
    median, most, worst = np.percentile(adaptive, [50, 95, 100])
    troubles = Counter(trouble["name"] for record in done for trouble in record["troubles"])
    said = "".join(f", {trouble} {count}" for trouble, count in sorted(troubles.items()))
    verdicts: Counter[str] = sum((Counter(record["verdicts_after"]) for record in done), Counter())

    def share(samples: int) -> float:
        return 100.0 * samples / max(1, verdicts.total())

    met = (
        median <= goal.median_pct and worst <= goal.worst_pct and over.max() <= goal.over_frozen
        and two.max() <= goal.two_seconds and len(done) == len(records)
    )  # fmt: skip
    return (
        *first,
        f"{median:.3f} / {most:.3f} / {worst:.3f}",
        f"{np.median(frozen):.3f}",
        f"{over.max():.2f} (seed {done[int(np.argmax(over))]['seed']})",
        f"{two.max():.2f} (seed {done[int(np.argmax(two))]['seed']})",
        f"{sum(bool(record['troubles']) for record in done)}{said}",
        f"{share(verdicts['learnt']):.0f} % ({share(verdicts['learnt'] + verdicts['passed']):.0f} %)",
        " / ".join(f"{100.0 * _values(done, name).mean():.0f} %" for name in ("outside", "stand_in")),
        str(goal),
        "yes" if met else "no",
    )


def repetition_table(records: Sequence[Record]) -> str:
    """Markdown: motions followed with and without the repetition."""
    rows = []
    for name in dict.fromkeys(record["motion"] for record in records):
        done = [record for record in records if record["motion"] == name and "repeated_pct" in record]
        if done:
            frozen, alone, repeated = (_values(done, key) for key in ("frozen_pct", *FOLLOWED.values()))
            rows.append(
                (name, str(len(done)), *(f"{np.median(v):.3f} / {v.max():.3f}" for v in (frozen, alone, repeated)),
                 f"{np.median(repeated / alone):.2f} / {(repeated / alone).max():.2f}",
                 f"{(repeated / frozen).max():.2f}", str(GOALS.get(name, Goal())))
            )  # fmt: skip
    head = ("motion", "runs", "frozen, median / worst", "learning, followed", "with repetition",
            "repetition over that", "worst repetition over frozen", "goal")  # fmt: skip
    return f"followed, readings {AGE} samples old\n\n{markdown(head, rows)}" if rows else ""


def table(records: Sequence[Record]) -> str:
    """Markdown: one row for each motion and kind of recording, in the order of `MOTIONS`."""
    kinds = list(MOTIONS)

    def place(name: str) -> tuple[int, float]:
        kind, _, frequency = name.partition(":")
        return kinds.index(kind), float(frequency or 0.0)

    parts = []
    for recording in RECORDINGS:
        of_it = [record for record in records if record["recording"] == recording]
        names = sorted({record["motion"] for record in of_it}, key=place)
        rows = [row(name, [record for record in of_it if record["motion"] == name]) for name in names]
        if rows:
            parts.append(f"identified from a {recording} recording\n\n{markdown(HEAD, rows)}")
            parts += filter(None, [repetition_table(sorted(of_it, key=lambda record: place(record["motion"])))])
    return "\n\n".join(parts)


def told(record: Record) -> str:
    """What a run came to, in words."""
    return (
        f"{record['motion']} {record['frequency_Hz']:.3g} Hz: {record['adaptive_pct']:.3f}, "
        f"frozen {record['frozen_pct']:.3f}, two seconds {record['two_seconds']:.2f}"
    )
