"""``dehyst scenarios``: compare adapting with not adapting in every kind of drift."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dehyst.service.cli.options import add_epilog, add_shared, progress_printer
from dehyst.service.protocol.errors import FieldError

if TYPE_CHECKING:
    from dehyst.lab.scenarios import Verdict

EPILOG = """\
Two twin stages have the same noise and the same reference. The learning model steers one, the same model as identified
the other. Displacement in µm, time in s, errors in percent of the commanded range (76 µm). In every 0.5 s the adaptive
error may be at most 1.1 times that of the frozen model plus three noise floors; if it is larger, the exit status is 1.

  dehyst scenarios --out out/scenarios
  dehyst scenarios --only glitches --only offset_jump --out out/sensor
  dehyst scenarios --only dwell --rest 1 --out out/stop
  dehyst scenarios --only gain_step --only creep --config learner.toml --out out/tuned
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add_epilog(parser, EPILOG, files=True)
    add = parser.add_argument
    add_shared(parser, out={"required": True, "help": "folder for table, JSON and pictures"})
    add("--seeds", type=int, default=2, metavar="N", help="scenarios of each kind, seeds 1 to N (2)")
    add("--only", action="append", default=[], metavar="NAME", help="a kind, or kind/seed; repeatable (all)")
    add("--rest", type=float, default=600.0, metavar="S", help="length of the rest of a dwell, s (600)")
    add("--config", type=Path, metavar="FILE", help="settings of the learner: a TOML file, or a service's")
    add("--jobs", type=int, default=1, metavar="N", help="scenarios at a time, one processor each (1)")
    add("--markdown", action="store_true", help="print the table as Markdown")
    add_shared(parser, "no-pictures", "quiet", "json")


def run(args: argparse.Namespace) -> int:
    """Run, judge, draw. Returns 0 if the limit held in all scenarios, else 1."""
    from dehyst.lab.scenarios import table
    from dehyst.service.config.learner import read_learner_settings
    from dehyst.service.storage.output import clear_output

    if not 1 <= args.seeds <= 1000:
        raise FieldError("--seeds", args.seeds, "an integer from 1 to 1000")
    if not 1 <= args.jobs <= 64:
        raise FieldError("--jobs", args.jobs, "an integer from 1 to 64")
    if not 0.0 < args.rest <= 86_400.0:
        raise FieldError("--rest", args.rest, "a time above 0 s, up to a day (86400 s)")
    settings = read_learner_settings(args.config).settings if args.config is not None else {}
    chosen = _chosen(args.only, args.seeds)
    clear_output(args.out)
    show = progress_printer(args.quiet)
    start = time.perf_counter()
    tasks = [(kind, seed, args.rest, settings, None if args.no_pictures else args.out) for kind, seed in chosen]
    verdicts: list[Verdict] = []
    for verdict in _all(tasks, args.jobs):
        verdicts.append(verdict)
        held = "held" if verdict.held else "NOT held"
        show(
            f"[{len(verdicts)}/{len(tasks)}] {verdict.name}: {verdict.text}: worst window {verdict.worst_ratio:.2f} of "
            f"what is allowed, {held} ({time.perf_counter() - start:.0f} s)"
        )
    summary: dict[str, Any] = {
        "schema": 1,
        "held": all(v.held for v in verdicts),
        "settings": settings,
        "scenarios": [v.as_dict() for v in verdicts],
        "seconds": round(time.perf_counter() - start, 1),
    }
    (args.out / "scenarios.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    (args.out / "scenarios.md").write_text(table(verdicts, markdown=True) + "\n", encoding="utf-8")
    if args.json:
        print(json.dumps(summary))
    else:
        print(table(verdicts, args.markdown))
        show(f"pictures, scenarios.json and scenarios.md are in {args.out}/")
    return 0 if summary["held"] else 1


def _chosen(only: list[str], seeds: int) -> list[tuple[str, int]]:
    from dehyst.sim.scenarios import SCENARIO_KINDS

    every = [(kind, seed) for kind in SCENARIO_KINDS for seed in range(1, seeds + 1)]
    if not only:
        return every
    chosen: list[tuple[str, int]] = []
    for name in only:
        kind, slash, number = name.partition("/")
        if kind not in SCENARIO_KINDS or (slash and not (number.isdigit() and int(number) >= 1)):
            raise FieldError("--only", repr(name), f"a kind, or kind/seed; kinds: {', '.join(SCENARIO_KINDS)}")
        chosen += [(kind, int(number))] if slash else [pair for pair in every if pair[0] == kind]
    return list(dict.fromkeys(chosen))


def _all(tasks: list[tuple[str, int, float, dict[str, Any], Path | None]], jobs: int) -> Any:
    if jobs == 1:
        yield from map(_one, tasks)
        return
    # One BLAS thread for each process, as the processes share the processors.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(_one, tasks)


def _one(task: tuple[str, int, float, dict[str, Any], Path | None]) -> Verdict:
    from dehyst.lab.scenarios import draw_course, judge, run_scenario
    from dehyst.sim.scenarios import scenario

    kind, seed, rest_s, settings, out = task
    course = run_scenario(scenario(kind, seed, rest_s), settings)
    verdict = judge(course)
    if out is not None:
        draw_course(out / f"{kind}_{seed}.png", course, verdict)
    return verdict
