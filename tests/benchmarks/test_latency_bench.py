"""The latency benchmark at its smallest: it reports what is promised, and what a live service learnt is exact.

No time is asserted: the machine that runs this may do anything else meanwhile.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.exactness import differing, offline_state, taught
from benchmarks.latency import TRAJECTORY, latency, page
from benchmarks.sample_feed import AXIS, STAGE, sent
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.model import fingerprint
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.service.conftest import DT_S, make_models

PERCENTILES = {"p50", "p99", "p999"}
BATCH = 10
#: So many samples wait at most in a service; below that none is dropped, however slow the machine is.
QUEUE: int = next(field.default for field in fields(AxisConfig) if field.name == "queue_samples")


@pytest.fixture(scope="module")
def report() -> dict[str, Any]:
    """Real processes: some seconds of samples at 1 kHz, ten a message, with queries and a follower beside them."""
    return latency(1000.0, BATCH, rounds=30, warm_s=1.0, every_sample=False)


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_what_scripts_read_is_there(report: dict[str, Any]) -> None:
    assert set(report["queries"]) == {"point", f"trajectory_{TRAJECTORY}"}
    for row in report["queries"].values():
        for which in ("echo_us", "service_us", "client_us"):
            assert set(row[which]) == PERCENTILES
            assert 0.0 < row[which]["p50"] <= row[which]["p99"] <= row[which]["p999"]
        for which in ("service", "client"):
            assert row[f"{which}_over_echo"]["p50"] == pytest.approx(row[f"{which}_us"]["p50"] / row["echo_us"]["p50"])
        assert row["payload_bytes"] > 0
        assert row["reply_bytes"] > 0
    follower = report["follower"]
    assert set(follower["point_us"]) == set(follower["snapshot_age_ms"]) == PERCENTILES
    assert follower["point_cpu_us"] > 0.0
    assert follower["snapshots"] > 1
    assert report["samples"]["handled_hz"] > 0.0
    assert report["samples"]["learnt_share"] > 0.0
    text = page(report)
    assert "p99.9" in text
    assert "Learnt exactly what the same samples teach off line: yes" in text


@pytest.mark.e2e
@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_live_service_learns_exactly_what_the_samples_teach(report: dict[str, Any]) -> None:
    exact = report["exactness"]
    assert exact["sent"] > 2000
    if exact["sent"] > QUEUE:
        pytest.skip("the machine took so long that the service's queue may have been full")
    assert (exact["handled"], exact["dropped"], exact["lost"]) == (exact["sent"], 0, 0)
    assert exact["learnt"] > 500
    assert report["learnt_exactly"], exact
    assert exact["differs"] == []
    assert exact["fingerprint"] == exact["fingerprint_offline"] != ""


def small_setup(folder: Path, samples: int = 600) -> Any:
    """What the comparison needs of a set-up: a configuration, and the samples of its stage."""
    meta = BundleMeta(STAGE, AXIS, DT_S, y_min_um=0.0, y_max_um=90.0)
    write_bundle(folder / "model.npz", make_models(), meta)
    (folder / "serve.toml").write_text(
        f'stage = "{STAGE}"\nlisten = ["tcp/127.0.0.1:1"]\n[[axis]]\nname = "{AXIS}"\nmodel = "model.npz"\n'
        "u_min_V = 0.0\nu_max_V = 10.0\nslew_V_per_s = 2000.0\n",
        encoding="utf-8",
    )
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * np.arange(samples) * DT_S)
    np.savez(folder / "samples.npz", u_V=(y_um - 1.0) / (11.0 * 0.95), y_um=y_um)
    return SimpleNamespace(
        config=folder / "serve.toml", samples=folder / "samples.npz", batch=BATCH, rate_hz=1.0 / DT_S
    )


def test_the_comparison_sees_one_sample_and_the_last_bit_of_it(tmp_path: Path) -> None:
    setup = small_setup(tmp_path)
    count = 900  # beyond the end of what is kept: it begins again
    axis = taught(setup, count, [])
    state = offline_state(axis)
    assert axis.sequence.received == count
    assert differing(state, offline_state(taught(setup, count, []))) == []
    # However they were gathered on the way.
    one_by_one = taught(setup, 0, [])
    with np.load(setup.samples) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    for k in range(count // BATCH):
        one_by_one.handle(sent(u_V, y_um, setup.rate_hz, BATCH, k))
    assert differing(state, offline_state(one_by_one)) == []
    # A message that was lost, and a voltage that is another in its last bit.
    assert differing(state, offline_state(taught(setup, count - BATCH, [])))
    u_V[450] = np.nextafter(u_V[450], 11.0)
    np.savez(setup.samples, u_V=u_V, y_um=y_um)
    other = taught(setup, count, [])
    assert any(name.startswith("learner.") for name in differing(state, offline_state(other)))
    learn = axis.config.learn
    assert fingerprint(other.newest.models[learn]) != fingerprint(axis.newest.models[learn])
