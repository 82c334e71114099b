"""The latency benchmark at its smallest: it reports what is promised, and what a live service learnt is exact.

No time is asserted: the machine that runs this may do anything else meanwhile.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.latency import latency, taught
from benchmarks.sample_feed import AXIS, STAGE
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.model import fingerprint
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.service.conftest import DT_S, make_models

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
def test_a_live_service_learns_exactly_what_the_samples_teach(report: dict[str, Any]) -> None:
    exact = report["exactness"]
    assert exact["sent"] > 2000
    if exact["sent"] > QUEUE:
        pytest.skip("the machine took so long that the service's queue may have been full")
    assert (exact["handled"], exact["dropped"], exact["lost"]) == (exact["sent"], 0, 0)
    assert exact["learnt"] > 500
    assert exact["learnt_exactly"], exact


def test_the_comparison_sees_one_sample_and_the_last_bit_of_it(tmp_path: Path) -> None:
    write_bundle(tmp_path / "model.npz", make_models(), BundleMeta(STAGE, AXIS, DT_S, y_min_um=0.0, y_max_um=90.0))
    (tmp_path / "serve.toml").write_text(
        f'stage = "{STAGE}"\nlisten = ["tcp/127.0.0.1:1"]\n[[axis]]\nname = "{AXIS}"\nmodel = "model.npz"\n'
        "u_min_V = 0.0\nu_max_V = 10.0\nslew_V_per_s = 2000.0\n",
        encoding="utf-8",
    )
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * 3.0 * np.arange(600) * DT_S)
    u_V = (y_um - 1.0) / (11.0 * 0.95)

    def told(count: int, portion: int = 37) -> str:
        np.savez(tmp_path / "samples.npz", u_V=u_V, y_um=y_um)
        axis = taught(tmp_path, 1.0 / DT_S, BATCH, count, portion)
        assert axis.sequence.received == count
        return fingerprint(axis.newest.models[axis.config.learn])

    count = 900  # beyond the end of what is kept: it begins again
    whole = told(count)
    assert told(count, portion=1) == whole, "however they were gathered on the way"
    # Messages that were lost before the last snapshot, and a voltage that is another in its last bit.
    assert told(count - 4 * BATCH) != whole
    u_V[450] = np.nextafter(u_V[450], 11.0)
    assert told(count) != whole
