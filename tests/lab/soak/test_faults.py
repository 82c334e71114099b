"""What a soak does to others: messages that nobody can use."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.soak.controller import StageClock
from dehyst.lab.soak.disturbers import PAYLOADS, TARGETS, bad_query
from dehyst.service.operating.verbs import decode_request
from dehyst.service.protocol import query as wire_query
from dehyst.service.protocol import samples as wire

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
    assert set(TARGETS) == set(PAYLOADS)
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


def test_a_controller_follows_the_stage_through_rubbish() -> None:
    session = SimpleNamespace(declare_subscriber=lambda *_: None)
    clock = StageClock(session)  # type: ignore[arg-type]

    def message(payload: bytes) -> Any:
        return SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: payload))

    clock._status(message(b'{"state": "running", "first": 5, "tick": 7}'))
    clock._sample(message(b"rubbish"))
    clock._sample(message(wire.encode_samples([8], [0.008], [1.0], [2.0])))
    assert clock.newest == 8
