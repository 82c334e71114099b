"""One rule of limits in every path: from outside, as after a restart with narrower ones, the way back is a ramp."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.service.answers.guard import Limits
from dehyst.service.client.client import Client, Known
from dehyst.service.config.settings import read_config
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.query import Answer, Pending, Trajectory
from dehyst.service.server.process import Service
from tests.service.conftest import DT_S, unused_port, write_config
from tests.service.living import Stage, eventually

LEARNING = "lssvm_adaptive"
#: 9 V were applied before; 5 V are allowed now, in steps of 0.1 V.
LIMITS = Limits(0.0, 5.0, 100.0, -50.0, 150.0)
RAMP_V = np.maximum(np.cumsum([9.0, *[-0.1] * 60])[1:], 5.0)


def answer_of(*u_V: float) -> Trajectory:
    u = np.array(u_V)
    return Answer(u, np.zeros(u.size), np.zeros(u.size, dtype=np.uint8), np.zeros(1), 0, LEARNING)


@pytest.mark.parametrize(
    ("before_V", "u_V", "wrong"),
    [
        (math.nan, (5.0,), None), (math.nan, (5.1,), 0), (5.0, (4.9,), None), (5.0, (4.8,), 0),
        (9.0, (9.0 - 0.1,), None), (9.0, (9.1,), 0), (9.0, (9.0,), 0),
        (9.0, (5.0,), 0), (9.0, tuple(RAMP_V), None), (9.0, tuple(-RAMP_V), 0),
        (9.0, (*RAMP_V[:5], *RAMP_V[:5]), 5), (math.nan, (math.nan,), 0), (4.0, (4.0, math.inf), 1),
    ],
)  # fmt: skip
def test_a_client_takes_the_answers_that_the_same_rule_leaves_as_they_are(
    before_V: float, u_V: tuple[float, ...], wrong: int | None
) -> None:
    known = Known({}, LIMITS, DT_S)
    if wrong is None:
        known.check(answer_of(*u_V), len(u_V), before_V)
        return
    with pytest.raises(FieldError, match=rf"u_V\[{wrong}\]: .*expected 0 to 5 V, in steps of at most 0.1 V"):
        known.check(answer_of(*u_V), len(u_V), before_V)


def test_a_command_after_a_gap_does_not_leave_the_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dehyst.service.client.client.zenoh.SourceInfo", lambda *_: None)
    querier = SimpleNamespace(id=None, undeclare=lambda: None)
    session: Any = SimpleNamespace(declare_querier=lambda *_, **__: querier)
    keys: Any = SimpleNamespace(feedforward="f", command="c")
    client, sent = Client(session, keys), list[bytes]()
    client._queries.known = Known({}, LIMITS, DT_S)
    client._lease = SimpleNamespace(put=sent.append)  # type: ignore[assignment]
    client.command(0, [5.0])
    client.command(40, [9.0, 9.0])  # it may have risen by 4.1 V meanwhile, but not above 5 V
    assert np.frombuffer(sent[-1][16:], "<f8").tolist() == [5.0, 5.0]
    client.command(62, [0.0, 0.0])  # 21 sample times after the last voltage
    np.testing.assert_allclose(np.frombuffer(sent[-1][16:], "<f8"), [2.9, 2.8])


def test_a_service_restarted_with_narrower_limits_comes_back_by_a_ramp(tmp_path: Path) -> None:
    """Trajectory, point, what is under way, and a command: each from a voltage that the limits no longer allow."""
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    text = config.read_text().replace("slew_V_per_s = 2000.0", "slew_V_per_s = 100.0")
    config.write_text(text)
    service = Service(read_config(config))
    service.start()
    y = np.full(60, 88.0)
    with Client.connect(f"tcp/127.0.0.1:{port}", wait_s=20.0, retry_s=20.0) as client:
        before = client.trajectory(y, 0.0 * y, 0.0 * y, begin=0)
        high_V = float(before.u_V[-1])
        assert 7.5 < high_V < 10.0
        service.close()
        config.write_text(text.replace("u_max_V = 10.0", "u_max_V = 5.0"))
        with Service(read_config(config)):
            ramp_V = np.maximum(high_V - 0.1 * np.arange(1, 61), 5.0)
            got = client.trajectory(y, 0.0 * y, 0.0 * y, after=before)
            np.testing.assert_allclose(got.u_V, ramp_V, atol=1e-12)
            one, alone = before, []
            for _ in range(60):
                one = client.point(88.0, after=one)
                alone.append(one.u_V)
            np.testing.assert_array_equal(alone, got.u_V)
            # What is under way lies outside too, as it was answered.
            under = client.trajectory(y, 0.0 * y, 0.0 * y, after=before, begin=60)
            np.testing.assert_allclose(under.u_V, ramp_V, atol=1e-12)
            client.status()
            assert client.limits == replace(client.limits, u_max_V=5.0)
            again = client.trajectory(y[:10], after=replaced_end(under, 20), begin=80)
            np.testing.assert_allclose(again.u_V, ramp_V[20:30], atol=1e-12)
            assert client.refused == 0


@pytest.mark.parametrize("deltas", [True, False])
def test_a_follower_takes_the_limits_of_the_service_that_replaces_the_first(tmp_path: Path, deltas: bool) -> None:
    config = write_config(tmp_path, port := unused_port(), extra=f'served = "{LEARNING}"')
    text = config.read_text().replace("slew_V_per_s = 2000.0", "slew_V_per_s = 100.0")
    config.write_text(text)
    service = Service(read_config(config))
    service.start()
    with Client.connect(f"tcp/127.0.0.1:{port}", wait_s=20.0, retry_s=20.0) as client:
        follower = client.follow(LEARNING, deltas=deltas)
        before_V = float(follower.trajectory(np.full(100, 80.0))[0][-1])
        assert before_V > 6.0
        service.close()
        config.write_text(text.replace("u_max_V = 10.0", "u_max_V = 5.0"))
        with Service(read_config(config)), Stage([f"tcp/127.0.0.1:{port}"]):
            eventually(lambda: follower.limits.u_max_V == 5.0, 20.0)
            points = np.array([before_V, *[follower.point(80.0) for _ in range(100)]])
            np.testing.assert_allclose(np.diff(points)[:10], -0.1, atol=1e-9)
            assert points[-1] == 5.0


def replaced_end(answer: Trajectory, kept: int) -> Trajectory:
    """The same when only ``kept`` of its voltages have been commanded."""
    assert answer.pending is not None
    first, y_um, u_V = answer.pending
    left = 60 - kept
    return answer._replace(u_V=answer.u_V[:kept], pending=Pending(first, y_um[:-left], u_V[:-left]))
