"""States from strangers and broken disks: each is refused with a reason, or does no harm; none ends the process."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.forged_states import DT_S, Victims, make_axis, recording
from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.online.learner import Parts
from dehyst.adaptive.state import rows
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.storage.checkpoint import CheckpointMeta, decode_checkpoint, encode_checkpoint

COUNT = 120


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    return decode_checkpoint(b"".join(encode_checkpoint(CheckpointMeta("demo", "x", DT_S, 1, 1), state)))[1]


def test_no_forged_state_ends_the_process_and_each_is_refused_or_harmless(tmp_path: Path) -> None:
    out = tmp_path / "outcomes.jsonl"
    command = [
        sys.executable,
        "-m",
        "benchmarks.forged_states",
        "--count",
        str(COUNT),
        "--seed",
        "1",
        "--out",
        str(out),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=dict(os.environ))
    lines = [json.loads(line) for line in out.read_text().splitlines()]
    assert done.returncode == 0, f"ended with {done.returncode} at {lines[-1]}\n{done.stderr[-2000:]}"
    outcomes = [line for line in lines if line["outcome"] != "begun"]
    assert len(outcomes) == COUNT
    wrong = [line for line in outcomes if not line["outcome"].startswith(("taken", "refused: "))]
    assert not wrong
    assert Counter(line["outcome"].split(":")[0] for line in outcomes)["refused"] > COUNT // 2


def test_the_refusal_names_the_entry_what_it_is_and_what_is_expected() -> None:
    axis = make_axis()
    axis.handle(recording(0, 500))
    state = through_a_file(axis.state_dict())
    window = "learner.model.lssvm_adaptive.window"
    before = axis.handled_seq
    for name, value, words in (
        (
            f"{window}.P",
            np.zeros((0, 0)),
            rf"{window}.P: got float64 \(0, 0\), expected an array of float64, a shape of \(60, 60\)",
        ),
        (f"{window}.order", np.zeros(60, np.int64), "expected each of 0 to 59 once"),
        (f"{window}.C", state[f"{window}.C"] + 1000, "expected at most the window.s 60 samples"),
        ("learner.champion", 4, "champion: got 4, expected a number from 0 to 3"),
        ("learner.names", "linear", "names: got 'linear', expected 'lssvm_adaptive,linear"),
        ("gates.learnt", 10**400, "expected an integer from -3 x 2.61"),
        ("gates.learnt", [1], "expected an integer"),
        ("sequence.gaps", np.zeros((2, 3), np.int64), r"gaps: got int64 \(2, 3\), expected .* a shape of \(n, 2\)"),
        ("learner.extra", np.zeros(3), "expected no entry of this name"),
        ("memory.mpi", np.zeros(99), r"memory.mpi: got float64 \(99,\), expected a shape"),
        ("learner.rows", np.full((2, 5), np.nan), "expected finite numbers"),
    ):
        with pytest.raises(ModelFileError, match=words):
            axis.restore(state | {name: value})
        assert axis.handled_seq == before


@pytest.mark.parametrize("alone", [True, False])
def test_no_state_of_an_axis_with_faulty_samples_is_refused(alone: bool) -> None:
    """A quarter of a minute of stuck, jumping, wild, missing and lost readings; a state is taken every 0.2 s or so."""
    rng = np.random.default_rng(3)
    axis, other = make_axis(alone), make_axis(alone)
    first = 0
    for _ in range(30):
        fault = str(rng.choice(["", "", "stuck", "jumped", "nan", "wild", "lost"]))
        for _ in range(int(rng.integers(1, 12))):
            batch = recording(first, 17, fault)
            first += 17
            if fault == "nan":
                batch = SampleBatch(batch.seq, batch.t_s, batch.u_V, np.where(rng.random(17) < 0.5, np.nan, batch.y_um))
            elif fault == "wild":
                batch = SampleBatch(batch.seq, batch.t_s, batch.u_V, batch.y_um * np.exp(rng.normal(0.0, 3.0, 17)))
            if fault != "lost" or rng.random() < 0.5:
                axis.handle(batch)
        other.restore(through_a_file(axis.state_dict()))
        assert other.handled_seq == axis.handled_seq


def test_no_motion_and_no_voltage_beyond_all_measure_is_taken() -> None:
    """Every entry of the learner in µm or V, or a rate of them, is bounded by the travel and by the drive."""
    axis = make_axis(alone=True)
    states = [state for alone, state in Victims().states.values() if alone]
    seen = set()
    for row in rows(Parts):
        about = row.meaning.rpartition("[")[2].rstrip("]")
        if not {"µm", "V"} & {word.partition("/")[0] for word in about.split(", ")}:
            continue
        name = "learner." + row.name
        state = next((state for state in states if np.size(state.get(name, ()))), None)
        if state is None:
            continue  # after a gap or a jump; of the same records as others
        seen.add(row.name)
        for wild in (1e90, -np.inf):
            forged = wild
            if isinstance(state[name], np.ndarray):
                forged = state[name].copy()
                forged.flat[-1] = wild
            with pytest.raises(ModelFileError, match=row.name):
                axis.restore(through_a_file(state) | {name: forged})
    assert {"front.hold.shift_um", "front.trial.window", "front.past_motion", "filter.beta"} <= seen
    assert len(seen) > 60


@pytest.mark.parametrize(
    "changes",
    [
        {"seq": "7"},
        {"seq": 2**70},
        {"samples": 1.5},
        {"dt_s": float("nan")},
        {"dt_s": "fast"},
        {"stage": 3},
        {"seq": True},
        {"dt_s": 0.0},
        {"models": {"linear": 1}},
        {"models": "linear"},
        {"unknown": 1},
    ],
)
def test_a_checkpoint_of_wrong_numbers_is_refused(changes: dict[str, Any]) -> None:
    valid = asdict(CheckpointMeta("demo", "x", DT_S, 1, 1, models={"linear": "00"}))
    assert CheckpointMeta.of({"meta": valid}) == CheckpointMeta(**valid)
    with pytest.raises(ModelFileError, match=next(iter(changes))):
        CheckpointMeta.of({"meta": valid | changes})
