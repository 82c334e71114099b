"""How soon the service adapts to a sudden change, by the age of its snapshot: the demonstration's stage and reference.

``python -m benchmarks.step`` runs the demonstration's plan without network and clock, from snapshots of several ages,
and prints the mean absolute error in percent of the commanded range beside the target.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adaptive.identification import identify_lssvm
from adaptive.inverse_model import LssvmInverse
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, Sample
from lab.demo.plan import ASKING_AHEAD, TEACHER, Plan, make_plan
from sim.stage.stage import Stage

#: Targets, percent of the commanded range: first second, 1 to 4 s, last ten seconds.
GOALS = {"first": 0.25, "then": 0.10, "settled": 0.03}
#: Ticks between the last sample that a snapshot has seen and the first point of its block; 0: point by point.
AGES = (0, 20, 40, 80)
SEEDS = tuple(range(20, 27))


def errors(plan: Plan, model: LssvmInverse, age: int) -> dict[str, float]:
    """One run with an age in ticks: errors in percent of the range, for the parts in ``GOALS`` and for "before"."""
    (wanted_um, v_um_per_s, a_um_per_s2), y_um = plan.reference(), np.zeros(plan.ticks)
    stage, learner = Stage(plan.stage(changing=True)), Learner.from_model(model)
    state, block = stage.initial_state(), plan.block if age else 1
    past: list[tuple[int, LssvmInverse, FloatArray]] = [(-1, learner.snapshot(), learner.memory())]
    for first in range(0, plan.ticks, block):
        part = slice(first, first + block)
        while len(past) > 1 and past[1][0] <= first - max(age, 1):
            past.pop(0)
        seen, served, memory = past[0]
        # As the service answers a query with ``begin``: from its own memory, along the pending commands.
        way = slice(seen + 1, first)
        memory = served.track(wanted_um[way], v_um_per_s[way], a_um_per_s2[way], np.zeros(first - seen - 1), memory)
        answer = served.feedforward(wanted_um[part], v_um_per_s[part], a_um_per_s2[part], memory)
        u_V = np.clip(answer.u_V, stage.config.u_min_V, stage.config.u_max_V)
        y_um[part] = stage.run(state, u_V)[0]
        for k in range(first, first + block):
            learner.handle(Sample(k, k * plan.dt_s, float(u_V[k - first]), float(y_um[k])))
            if k % block == 0:
                now = learner.snapshot()
                memory = learner.memory_for(now)
                assert memory is not None  # it has seen a sample
                past.append((k, now, memory))
    return _parts(plan, 100.0 * np.abs(y_um - wanted_um) / plan.range_um)


def _parts(plan: Plan, error_pct: FloatArray) -> dict[str, float]:
    second, change = round(1.0 / plan.dt_s), plan.change_tick
    parts = plan.phases() | {
        "first": slice(change, change + second),
        "then": slice(change + second, change + 4 * second),
    }
    return {name: float(error_pct[parts[name]].mean()) for name in ("before", *GOALS)}


def identified(plan: Plan) -> LssvmInverse:
    """The model of the stage at rest, as the demonstration identifies it."""
    stage, u_V = Stage(plan.stage(changing=False)), plan.identification_voltage()
    y_um, _ = stage.run(stage.initial_state(), u_V)
    return identify_lssvm(u_V, y_um, plan.dt_s, inputs="memory", name=TEACHER)[0]


def table(rows: dict[int, list[dict[str, float]]]) -> str:
    """Markdown: one row per age, mean over the seeds and the worst of them."""
    lines = ["| age | before | first second | 1 to 4 s | settled |", "|---|---|---|---|---|"]
    for age, runs in rows.items():
        when = f"{age} ms" if age else "none, point by point"
        cells = [f"{np.mean([r[n] for r in runs]):.3f} ({max(r[n] for r in runs):.3f})" for n in ("before", *GOALS)]
        lines.append(f"| {when} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "| asked for | | " + " | ".join(f"{goal:.2f}" for goal in GOALS.values()) + " |"])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run all ages and seeds; prints a line per run, then the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.step", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), metavar="N")
    parser.add_argument(
        "--ages", type=int, nargs="+", default=list(AGES), metavar="TICKS", help="multiples of 20, or 0"
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a run; the change comes half-way")
    parser.add_argument("--json", type=Path, help="write every run's numbers here")
    given = parser.parse_args(arguments)
    block = int(ASKING_AHEAD["block"])
    if any(age < 0 or age % block for age in given.ages):
        parser.error(f"--ages: got {given.ages}, expected multiples of {block} ticks, or 0")
    rows: dict[int, list[dict[str, float]]] = {age: [] for age in given.ages}
    for seed in given.seeds:
        plan = make_plan(given.seconds, seed, ahead=True)
        model = identified(plan)
        for age in given.ages:
            rows[age].append(errors(plan, model, age))
            print(f"seed {seed} age {age}:", json.dumps({k: round(v, 4) for k, v in rows[age][-1].items()}), flush=True)
    if given.json:
        given.json.write_text(json.dumps({str(age): runs for age, runs in rows.items()}, indent=1) + "\n")
    print(f"\nmean over the seeds {given.seeds} (worst of them), % of the commanded range\n")
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
