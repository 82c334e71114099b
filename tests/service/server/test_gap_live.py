"""A gap in the samples of a running service: its memory is that of a learner in this process, to the last bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client
from dehyst.service.config.settings import AxisConfig
from dehyst.service.identification.identifying import motion_of
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from dehyst.sim.recordings import Recording
from dehyst.sim.signals.voltages import multitone, training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.service.conftest import ServeProcess

DT_S, A_MESSAGE = 1e-3, 20
#: The samples of the gap, and the last one sent.
FIRST_LOST, FIRST_AGAIN, END = 3500, 4200, 6000
MODEL = "lssvm_adaptive"


@pytest.mark.e2e
def test_service_and_learner_agree_after_a_gap_and_state_what_they_do_not_know(tmp_path: Path, free_port: int) -> None:
    stage = Stage(preset("rich", seed=4))
    state = stage.initial_state()
    training_V = training_input(DT_S, 10.0)[1]
    model = identify_lssvm(
        training_V, stage.run(state, training_V)[0], DT_S, config=IdentifyConfig(n=120, tune=False), name=MODEL
    )[0]
    u_V = multitone(END * DT_S, DT_S, seed=4)[1][:END]
    u_V[:500] *= np.linspace(0.0, 1.0, 500)
    y_um = stage.run(stage.initial_state(), u_V)[0]
    seq = np.arange(END)
    motion = motion_of(Recording(seq * DT_S, u_V, y_um, DT_S))
    write_bundle(tmp_path / "x.npz", {MODEL: model}, BundleMeta("demo", "x", DT_S, y_min_um=-10.0, y_max_um=120.0))
    path = tmp_path / "serve.toml"
    path.write_text(
        f'stage = "demo"\nlisten = ["tcp/127.0.0.1:{free_port}"]\n[[axis]]\nname = "x"\nmodel = "x.npz"\n'
        f'served = "{MODEL}"\nlearn = "{MODEL}"\nu_min_V = -5.0\nu_max_V = 15.0\nslew_V_per_s = 1e6\n',
        encoding="utf-8",
    )
    threadpool_limits(1)  # as the service does: the last bits depend on it
    local = load_axis("demo", AxisConfig("x", tmp_path / "x.npz", Limits(-5.0, 15.0, 1e6), served=MODEL, learn=MODEL))
    process = ServeProcess(path, free_port)
    try:
        with Client.connect(process.endpoint, axis="x", timeout_s=5.0) as client:
            for k in range(0, END, A_MESSAGE):
                part = slice(k, k + A_MESSAGE)
                if not FIRST_LOST <= k < FIRST_AGAIN:
                    client.samples(seq[part], seq[part] * DT_S, u_V[part], y_um[part])
                    local.handle(SampleBatch(seq[part], seq[part] * DT_S, u_V[part], y_um[part]))
                    client.wait_learnt(k + A_MESSAGE - 1)  # on a busy machine samples would be thinned
            snapshots = {served.seq: served for served in local.snapshots}
            error_V, std_V = [], []
            for at in range(FIRST_AGAIN, FIRST_AGAIN + 300, A_MESSAGE):
                due = slice(at + 1, at + 1 + A_MESSAGE)
                wanted = [np.ascontiguousarray(motion[due, i]) for i in range(3)]
                answer = client.trajectory(*wanted, as_of=at, model=MODEL, wait_s=10.0)
                served = snapshots[answer.snapshot_seq]
                expected = served.models[MODEL].feedforward(*wanted, served.memories[MODEL])
                assert answer.snapshot_seq == at
                assert np.array_equal(answer.memory, expected.memory)
                error_V.append(answer.u_V - u_V[due])
                std_V.append(answer.std_V)
            lost = client.status()["samples"]["lost"]
    finally:
        process.kill()
    inside = np.abs(error_V) <= np.array(std_V)
    assert lost == FIRST_AGAIN - FIRST_LOST
    assert inside[0].all()
    assert inside.mean() > 0.95
    assert np.abs(error_V).mean() < 0.005 * np.ptp(u_V)
