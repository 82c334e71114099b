"""Whether a live service has learnt exactly what its samples teach, compared with an axis that learns them offline.

The learner is deterministic sample by sample, so both states must agree to the last bit, however the samples were
grouped on their way. A sample that was dropped, doubled or exchanged gives another state.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import zenoh
from threadpoolctl import threadpool_limits

from benchmarks.latency_setup import CONNECT_S, LatencySetup, RunningSetup
from benchmarks.sample_feed import AXIS, STAGE, sent
from dehyst.adaptive.types import StateDict
from dehyst.service.background.adoptions import Retuned
from dehyst.service.client.client import Client
from dehyst.service.config.settings import AxisConfig, read_config
from dehyst.service.failover.state_transfer import fetch_state
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.model import fingerprint
from dehyst.service.protocol.samples import joined
from dehyst.service.security.authenticator import own_authenticator
from dehyst.service.server.axis import Axis
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.checkpoint import CheckpointMeta, decode_checkpoint, encode_checkpoint

#: Messages that the offline axis gets at a time; a live service never groups them so.
_PORTION: Final = 37
#: Longest time until the queue of the service is empty, and until nothing more arrives, s.
_DRAIN_S: Final = 60.0
_STILL_S: Final = 5.0
#: Number of differing entries that are named.
_NAMED: Final = 8


@dataclass(slots=True)
class Adopted:
    """The hyper-parameters that the live learner has adopted, each at a definite sample, from its events."""

    session: zenoh.Session
    key: str
    retuned: list[Retuned] = field(default_factory=list)
    _subscriber: Any = None

    def __enter__(self) -> Adopted:
        self._subscriber = self.session.declare_subscriber(self.key, self._hear)
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.undeclare()

    def _hear(self, sample: zenoh.Sample) -> None:
        told = json.loads(sample.payload.to_bytes())
        if told.get("event") == "retuned":
            self.retuned.append(Retuned.from_json(told["retuned"]))


def exactness(running: RunningSetup, client: Client, adopted: Adopted) -> dict[str, Any]:
    """Stop the stage, let the service handle its queue, and compare the learners; counts and verdict for JSON."""
    running.feed.stop()
    count = int(running.feed.last_json()["sent"])
    status = _drained(client, count)
    live = _live_state(client)
    axis = taught(running.setup, count, adopted.retuned)
    differs = differing(live, offline_state(axis))
    told = fingerprint(axis.newest.models[axis.config.learn])
    if status["fingerprint"] != told:
        differs.append("fingerprint")
    samples = status["samples"]
    return {
        "learnt_exactly": not differs,
        "sent": count,
        "handled": samples["received"],
        "learnt": samples["learnt"],
        **{name: samples[name] for name in ("dropped", "lost", "late", "waiting")},
        "retuned": len(adopted.retuned),
        "fingerprint": status["fingerprint"],
        "fingerprint_offline": told,
        "differs": differs[:_NAMED],
    }


def taught(setup: LatencySetup, count: int, retuned: list[Retuned]) -> Axis:
    """An axis of the same configuration that learns the first ``count`` samples of the stage offline."""
    with np.load(setup.samples) as kept:
        u_V, y_um = kept["u_V"], kept["y_um"]
    config: AxisConfig = read_config(setup.config).axes[0]
    # One BLAS thread as in the service: more may sum in another order.
    with threadpool_limits(1):
        axis = load_axis(STAGE, config)
        for entry in retuned:
            axis.adopt_at(entry)
        messages = count // setup.batch
        for first in range(0, messages, _PORTION):
            part = range(first, min(first + _PORTION, messages))
            axis.handle(joined([sent(u_V, y_um, setup.rate_hz, setup.batch, k) for k in part]))
    return axis


def offline_state(axis: Axis) -> StateDict:
    """The state of an axis as a service would send it, through its bytes."""
    meta = CheckpointMeta(STAGE, AXIS, axis.dt_s, axis.handled_seq, axis.sequence.received)
    return decode_checkpoint(b"".join(encode_checkpoint(meta, axis.state_dict())))[1]


def differing(live: StateDict, offline: StateDict) -> list[str]:
    """Names of the entries that are not identical to the last bit, or not in both."""
    return [name for name in sorted({*live, *offline}) if not _same(live.get(name), offline.get(name))]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    return type(a) is type(b) and bool(a == b)


def _drained(client: Client, count: int) -> dict[str, Any]:
    """The status when all ``count`` samples are handled, or when nothing changes any more."""
    until = time.monotonic() + _DRAIN_S
    seq, still_since = -2, time.monotonic()
    while True:
        status, now = client.status(), time.monotonic()
        if status["seq"] != seq or status["samples"]["waiting"]:
            seq, still_since = status["seq"], now
        done = seq >= count - 1 and not status["samples"]["waiting"]
        if done or now - still_since >= _STILL_S or now >= until:
            return status
        time.sleep(0.05)


def _live_state(client: Client) -> StateDict:
    """The state of the service as it sends it to a standby. Raises ServiceError if it does not."""
    until = time.monotonic() + CONNECT_S
    while time.monotonic() < until:
        data = fetch_state(client._session, client.keys.state, CONNECT_S, authenticator=own_authenticator())
        if data is not None:
            return decode_checkpoint(data)[1]
        time.sleep(0.1)  # it refuses while its learner is busy
    raise ServiceError(f"{client.keys.state}: the service did not tell its state")
