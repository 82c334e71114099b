"""A replay is the live learner again: the same snapshots to the last bit, honest errors, every gate counted."""

from __future__ import annotations

import csv
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.learner import Learner
from dehyst.lab.cli import main
from dehyst.service.answers.guard import Limits
from dehyst.service.config.learner import read_learner_settings
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.replay import Replayed, replay, summary, write_gates
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import BundleMeta, read_bundle, write_bundle
from dehyst.sim.recordings import Recording
from dehyst.sim.signals.voltages import multitone, training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

DT_S = 1e-3


@pytest.fixture(scope="module")
def model() -> LssvmInverse:
    stage = Stage(preset("rich", seed=4))
    u_V = training_input(DT_S, 10.0)[1]
    y_um, _ = stage.run(stage.initial_state(), u_V)
    return identify_lssvm(u_V, y_um, DT_S, config=IdentifyConfig(n=120, tune=False), name="lssvm_adaptive")[0]


@pytest.fixture(scope="module")
def model_file(model: LssvmInverse, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "x.npz"
    meta = BundleMeta("demo", "x", DT_S, y_min_um=0.0, y_max_um=90.0, u_min_V=0.0, u_max_V=8.0)
    write_bundle(path, {"lssvm_adaptive": model}, meta)
    return path


@pytest.fixture(scope="module")
def samples() -> Recording:
    """Six seconds in motion; the gain drops after three; some readings are wrong, some are missing."""
    config = replace(preset("rich", seed=4), changes=((3.0, {"gain_drift.gain": -0.06}),))
    stage = Stage(config)
    u_V = multitone(6.0, DT_S, seed=4)[1]
    u_V[:500] *= np.linspace(0.0, 1.0, 500)
    y_um, _ = stage.run(stage.initial_state(), u_V)
    y_um[1500] += 20.0
    y_um[1700:1702] = np.nan
    keep = np.ones(y_um.size, dtype=np.bool_)
    keep[2000:2003] = False
    seq = np.arange(y_um.size)[keep]
    return Recording(seq * DT_S, u_V[keep], y_um[keep], DT_S, source="six seconds", seq=seq)


def axis_of(path: Path) -> Axis:
    return load_axis("demo", AxisConfig("x", path, Limits(-2.0, 10.0, 4000.0)))


@pytest.fixture(scope="module")
def replayed(model_file: Path, samples: Recording) -> Replayed:
    return replay(samples, axis_of(model_file))


def test_learning_pays_after_the_change_and_every_sample_is_accounted_for(
    replayed: Replayed, samples: Recording
) -> None:
    settled = replayed.t_s > 4.0
    frozen = np.nanmean(np.abs(replayed.frozen_V[settled]))
    assert np.nanmean(np.abs(replayed.adaptive_V[settled])) < 0.3 * frozen
    numbers = summary(replayed, span_V=8.0, bins=10)
    assert sum(numbers["gates"].values()) == numbers["samples"] == len(samples)
    assert numbers["gates"]["glitch"] >= 1
    assert numbers["gates"]["not_finite"] == 2
    assert len(numbers["over_time"]) == 10
    assert sum(sum(part["gates"].values()) for part in numbers["over_time"]) == len(samples)
    assert numbers["over_time"][-1]["adaptive"]["mae_V"] < numbers["over_time"][-1]["frozen"]["mae_V"]
    json.dumps(numbers, allow_nan=False)


def test_what_was_filled_in_is_not_scored(replayed: Replayed) -> None:
    unscored = np.flatnonzero(~np.isfinite(replayed.adaptive_V))
    # Missing samples and readings that were none; the spike was there, and counts.
    assert set(unscored) == {1700, 1701, 2000, 2001, 2002}
    assert replayed.repaired


def test_nothing_is_foretold_from_what_comes_later(model_file: Path, samples: Recording, replayed: Replayed) -> None:
    """Other voltages from 4 s on change no error before: what is foretold has not seen them."""
    other = replace(samples, u_V=np.where(samples.t_s < 4.0, samples.u_V, samples.u_V[::-1]))
    one, two = replayed, replay(other, axis_of(model_file))
    before = one.t_s < 4.0
    assert np.array_equal(one.adaptive_V[before], two.adaptive_V[before], equal_nan=True)
    assert not np.array_equal(one.adaptive_V[~before], two.adaptive_V[~before], equal_nan=True)


def test_settings_are_read_from_a_service_or_from_a_file_of_their_own(tmp_path: Path) -> None:
    serve = tmp_path / "serve.toml"
    axis = '[[axis]]\nname = "{}"\nmodel = "x.npz"\nu_min_V = 0.0\nu_max_V = 8.0\nslew_V_per_s = 100.0\n'
    serve.write_text('stage = "demo"\n' + axis.format("x") + "[axis.learner]\nwindow = 300\n", encoding="utf-8")
    found = read_learner_settings(serve)
    assert found.settings == {"window": 300}
    assert found.axis is not None
    assert found.axis.model == tmp_path / "x.npz"
    own = tmp_path / "learner.toml"
    own.write_text("window = 200\n[drift]\nnoise = 0.002\n", encoding="utf-8")
    assert read_learner_settings(own).settings == {"window": 200, "drift": {"noise": 0.002}}
    own.write_text("[learner]\nwindow = 250\n", encoding="utf-8")
    assert read_learner_settings(own).settings == {"window": 250}
    own.write_text("windw = 200\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"windw.*expected one of the known keys"):
        read_learner_settings(own)
    serve.write_text('stage = "demo"\n' + axis.format("x") + axis.format("y"), encoding="utf-8")
    with pytest.raises(InputError, match="--axis"):
        read_learner_settings(serve)
    found = read_learner_settings(serve, "y")
    assert found.axis is not None
    assert found.axis.name == "y"


def written(recording: Recording, path: Path) -> Path:
    columns = np.column_stack([recording.t_s, recording.u_V, recording.y_um])
    np.savetxt(path, columns, delimiter=",", header="t_s,u_V,y_um", comments="", fmt="%.17g")
    return path


def decisions(path: Path) -> list[tuple[int, float, str]]:
    """(seq, t_s, decision) of every line of a ``gates.csv``."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["seq", "t_s", "decision"]
    return [(int(seq), float(t_s), decision) for seq, t_s, decision in rows]


def test_every_row_has_its_decision_also_where_it_is_doubled_late_or_without_a_time(
    model_file: Path, samples: Recording, tmp_path: Path
) -> None:
    """In the recording's order, and what the axis says where the same samples come one by one."""
    rows = np.arange(900)
    rows[500] = 499
    rows[600] = 300
    taken = {name: np.asarray(getattr(samples, name))[rows] for name in ("t_s", "u_V", "y_um", "seq")}
    taken["t_s"][700] = np.nan
    recording = Recording(**taken, dt_s=DT_S, source="in disorder")
    write_gates(tmp_path / "gates.csv", replay(recording, axis_of(model_file)))
    told = decisions(tmp_path / "gates.csv")
    assert [seq for seq, _, _ in told] == rows.tolist()
    assert np.array_equal([t_s for _, t_s, _ in told], taken["t_s"], equal_nan=True)
    live = axis_of(model_file)
    columns = [taken[name] for name in ("seq", "t_s", "u_V", "y_um")]
    said = [live.handle(SampleBatch(*(column[k : k + 1] for column in columns))) for k in range(900)]
    assert [decision for _, _, decision in told] == [verdict for (verdict,) in said]
    assert [told[k][2] for k in (500, 600, 700)] == ["duplicate", "out_of_order", "not_finite"]


def test_the_command_leaves_numbers_pictures_and_the_model_at_the_end(
    model_file: Path, samples: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "learner.toml"
    config.write_text("window = 120\n", encoding="utf-8")
    out = tmp_path / "out"
    data = written(samples, tmp_path / "six.csv")
    arguments = ["replay", str(data), "--config", str(config), "--model", str(model_file), "--out", str(out), "--json"]
    assert main(arguments) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "replay.json").read_text(encoding="utf-8"))
    assert printed["schema"] == 1
    assert printed["settings"] == {"window": 120}
    assert printed["adaptive"]["mae_V"] < printed["frozen"]["mae_V"]
    for name in ("errors.png", "gates.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    decided = decisions(out / "gates.csv")
    assert len(decided) == len(samples) == printed["samples"]
    assert [seq for seq, _, _ in decided] == np.rint(samples.t_s / DT_S).astype(int).tolist()
    assert [t_s for _, t_s, _ in decided] == samples.t_s.tolist()
    assert Counter(said for _, _, said in decided) == {name: n for name, n in printed["gates"].items() if n}
    # Each verdict is beside its sample: those that had no reading, and the reading that was 20 µm off.
    said = {seq: verdict for seq, _, verdict in decided}
    assert [seq for seq, verdict in said.items() if verdict == "not_finite"] == [1700, 1701]
    assert said[1500] == "glitch"
    last = read_bundle(out / "model.npz").models["lssvm_adaptive"]
    assert isinstance(last, LssvmInverse)
    assert last.seq >= 5900
    # It can be gone on from: a learner starts from it.
    assert Learner.from_model(last).snapshot().dt_s == DT_S


def test_the_command_says_what_it_lacks(
    model_file: Path, samples: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "learner.toml"
    config.write_text("", encoding="utf-8")
    data = written(samples.part(0, 300), tmp_path / "six.csv")
    base = ["replay", str(data), "--config", str(config), "--out", str(tmp_path / "out")]
    assert main(base) == 2
    assert "--model" in capsys.readouterr().err
    assert main([*base, "--model", str(model_file), "--learn", "mpi"]) == 2
    assert "--learn" in capsys.readouterr().err
    assert main([*base, "--model", str(model_file), "--dt-s", "0.01"]) == 2
    assert "sample time" in capsys.readouterr().err


def test_after_a_long_gap_the_memory_is_the_learners(model_file: Path) -> None:
    """The replay used to go on along a straight line for good, wherever the stage had turned meanwhile."""
    stage = Stage(preset("rich", seed=4))
    u_V = multitone(8.0, DT_S, seed=4)[1]
    u_V[:500] *= np.linspace(0.0, 1.0, 500)
    y_um, _ = stage.run(stage.initial_state(), u_V)
    t_s = np.arange(u_V.size) * DT_S
    keep = np.ones(u_V.size, dtype=np.bool_)
    first = 5130
    keep[4130:first] = False
    whole = replay(Recording(t_s, u_V, y_um, DT_S, source="whole"), axis_of(model_file))
    cut = Recording(t_s[keep], u_V[keep], y_um[keep], DT_S, source="gap", seq=np.flatnonzero(keep))
    gapped = replay(cut, axis_of(model_file))
    error, std, usual = np.abs(gapped.adaptive_V), gapped.std_V, np.abs(whole.adaptive_V)
    # Scored from the first snapshot on that has seen a sample after the gap.
    scored = np.flatnonzero(np.isfinite(error[first:]))
    assert scored[0] < 100
    early = first + scored[scored < 300]
    assert np.mean(error[early] <= std[early]) > 0.95
    assert error[early].mean() < 0.005 * np.ptp(u_V)
    assert error[first + 1000 :].mean() < 1.5 * usual[first + 1000 :].mean()
    frozen, as_usual = (np.nanmean(np.abs(r.frozen_V[first + 1000 :])) for r in (gapped, whole))
    assert frozen < 1.5 * as_usual
