"""What a soak does to others: every kind that was promised, and messages that nobody can use."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.soak import disturbers
from dehyst.lab.soak.controller import StageClock
from dehyst.lab.soak.disturbers import PAYLOADS, RATE_HZ, TARGETS, bad_query, bad_request, bad_samples
from dehyst.lab.soak.fault_plan import FAULT_KINDS
from dehyst.lab.soak.observed import INDICATORS
from dehyst.service.operating.verbs import decode_request
from dehyst.service.protocol import query as wire_query
from dehyst.service.protocol import samples as wire

#: What the promise names, and by which kind it is kept.
PROMISED = {
    "kill -9": "kill_primary",
    "SIGSTOP for seconds": "stop_primary",
    "a standby that is killed": "kill_standby",
    "a killed viewer": "kill_viewer",
    "dead viewers": "kill_viewer",
    "slow viewers": "slow_viewer",
    "a dead stage": "restart_stage",
    "a restarted router": "restart_router",
    "a clock set back": "clock_back",
    "a stage's clock set back": "stage_clock",
    "gaps": "gap",
    "duplicates": "duplicate",
    "reordering": "reorder",
    "NaN": "nan",
    "spikes": "spike",
    "saturation": "saturate",
    "dwell": "dwell",
    "sensor frozen": "freeze",
    "gain changes": "gain",
    "payload changes": "payload",
    "bursts of bad queries": "bad_queries",
    "disk full": "disk_full",
    "CPU stolen": "cpu_stolen",
    "a stuck sensor with any noise": "stuck_noisy",
    "a sensor's gain": "sensor_gain",
    "a flipped sign": "sign",
    "another stage's data": "other_stage",
    "one sample with a high number": "seq_jump",
    "95 % loss": "losses",
    "forged states": "forged_state",
    "a stranger's claim": "rogue_claim",
    "a folder removed while it is recorded into": "folder_removed",
    "freeze over a restart": "freeze_restart",
}


def test_every_kind_that_was_promised_is_there_and_no_other() -> None:
    assert set(PROMISED.values()) == set(FAULT_KINDS)
    assert set(INDICATORS) <= set(FAULT_KINDS)


DECODERS: dict[str, Callable[[bytes], object]] = {"sample": wire.decode_samples, "operate": decode_request}


@pytest.mark.parametrize("key", sorted(DECODERS))
def test_rubbish_is_refused_by_whoever_reads_it(key: str) -> None:
    """Samples that could be read would be believed, and a verb that could be read would be done."""
    rng = np.random.default_rng(7)
    kinds = set()
    for _ in range(1500):
        with pytest.raises(InputError) as caught:
            DECODERS[key](PAYLOADS[key](rng))
        kinds.add(str(caught.value).split(":")[0])
    assert len(kinds) >= 3, "of several sorts"


def test_rubbish_goes_to_every_key_in_turns() -> None:
    assert set(TARGETS) == set(PAYLOADS) == {"feedforward", "sample", "model", "status", "operate"}
    assert (PAYLOADS["feedforward"], PAYLOADS["sample"], PAYLOADS["operate"]) == (bad_query, bad_samples, bad_request)
    rng = np.random.default_rng(3)
    # Some of the queries can be read, and ask what cannot be answered.
    read = 0
    for _ in range(300):
        try:
            wire_query.decode_query(bad_query(rng))
            read += 1
        except InputError:
            pass
    assert 50 < read < 250


class Session:
    """Takes what is sent to it, and answers nothing."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def put(self, key: str, payload: bytes, attachment: bytes, congestion_control: object) -> None:
        assert len(attachment) == 32
        self.sent.append(key)

    def get(self, key: str, payload: bytes, timeout: float) -> list[Any]:
        self.sent.append(key)
        return []


def test_rubbish_comes_at_a_bounded_rate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    session, until = Session(), time.monotonic() + 0.5
    monkeypatch.setattr(disturbers, "open_client", lambda *_: session)

    class Stop:
        @property
        def reason(self) -> str:
            return "over" if time.monotonic() > until else ""

    monkeypatch.setattr(disturbers, "StopSignal", Stop)
    disturbers.send_malformed("nowhere", "dehyst/soak/x", 1)
    assert 8 < len(session.sent) <= 0.5 * RATE_HZ + 5
    assert {key.rsplit("/", 1)[1].split("?")[0] for key in session.sent} == set(TARGETS)
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["published"] == sum(key.endswith("/sample") for key in session.sent)
    assert told["nothing"] == len(session.sent) - told["published"]


def test_a_controller_follows_the_stage_through_rubbish() -> None:
    session = SimpleNamespace(declare_subscriber=lambda *_: None)
    clock = StageClock(session)  # type: ignore[arg-type]

    def message(payload: bytes) -> Any:
        return SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload))

    clock._status(message(b'{"state": "running", "first": 5, "tick": 7}'))
    clock._sample(message(b"rubbish"))
    clock._sample(message(wire.encode_samples([8], [0.008], [1.0], [2.0])))
    assert clock.newest == 8
