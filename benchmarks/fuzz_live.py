"""A live service under malformed messages: what they cost an honest client, compared with honest load.

The honest client asks for one point at a steady rate, under honest queries from another process and then under
malformed payloads at the same rate. Malformed load must cost no more than honest load.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil

from benchmarks.fuzz_targets import seeds
from benchmarks.mutations import mutated
from dehyst.adaptive.errors import DehystError
from dehyst.lab.testbed.identified_stage import Rig, write_service_config
from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.runtime.session import SURELY, open_client
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from tests.service.conftest import make_models

_STAGE, _AXIS = "fuzz", "x"
_PACE_HZ: Final = 200.0
#: Limit of the honest client's p99 under malformed payloads, as a multiple of its p99 under honest ones; or as a
#: difference, µs, where both are within the machine's own noise.
_P99_RATIO: Final = 1.5
_P99_NOISE_US: Final = 300.0
_GROWTH_MB: Final = 16.0
_OVERSIZED_EVERY: Final = 997


def bombard(out: Path, duration_s: float, rate_hz: float, seed: int) -> dict[str, Any]:
    """Send malformed payloads to a service on loopback for about ``duration_s``; returns the verdict and its
    numbers."""
    out.mkdir(parents=True, exist_ok=True)
    model, config = out / "x.npz", out / "serve.toml"
    write_bundle(model, make_models(), BundleMeta(_STAGE, _AXIS, 1e-3, y_min_um=0.0, y_max_um=90.0))
    with Rig(out) as rig:
        axis = {"name": _AXIS, "model": model, "u_min_V": 0.0, "u_max_V": 10.0, "slew_V_per_s": 2000.0}
        write_service_config(config, _STAGE, axis, listen=[rig.endpoint])
        try:
            service = rig.start_service(config)
        except ServiceError as error:
            return {"held": False, "why": str(error)}
        with Client.connect(rig.endpoint, _STAGE, _AXIS, timeout_s=5.0) as client:
            told = _phases(client, rig, duration_s, rate_hz, seed, psutil.Process(service.pid))
        service.send(signal.SIGTERM)
        told["exit"] = service.wait(30.0)
    honest_us, malformed_us = (told[phase]["p99_us"] for phase in ("honest_fire", "malformed_fire"))
    told["checks"] = {
        "ends_well": told["exit"] == 0,
        "all_answered": told["unanswered"] == 0 and told["malformed_fire"]["failed"] == 0,
        "no_growth": told["growth_MB"] <= _GROWTH_MB,
        "p99": malformed_us <= max(_P99_RATIO * honest_us, honest_us + _P99_NOISE_US),
    }
    told["held"] = all(told["checks"].values())
    print(
        f"live       {told['fired']} payloads, {told['unanswered']} unanswered, {told['growth_MB']:+.1f} MB; p99 of "
        f"the honest client {honest_us:.0f} us under honest fire, {malformed_us:.0f} us under malformed fire"
        + "".join(f"; NOT held: {name}" for name, held in told["checks"].items() if not held),
        flush=True,
    )
    return told


def _phases(
    client: Client, rig: Rig, duration_s: float, rate_hz: float, seed: int, service: psutil.Process
) -> dict[str, Any]:
    share_s = duration_s / 4
    _pace(client, min(2.0, share_s))  # until everything that is created at first use exists
    told: dict[str, Any] = {}
    settled, counts = 0, {}
    for phase, length_s in (("honest_fire", share_s), ("malformed_fire", 2 * share_s)):
        bad = phase == "malformed_fire"
        order = [rig.endpoint, str(length_s + 1.0), str(rate_hz), str(seed), "bad" if bad else "honest"]
        firing = rig.start("fire", ["-m", "benchmarks.fuzz_live", *order])
        if bad:  # the first oversized payloads leave buffers behind, once
            _pace(client, 0.3 * length_s)
            settled = service.memory_info().rss
        told[phase] = _pace(client, 0.7 * length_s if bad else length_s)
        firing.wait(120.0)
        counts = firing.last_json()
    status = client.status()
    return told | counts | {
        "growth_MB": (service.memory_info().rss - settled) / 1e6,
        "malformed_samples": status["samples"]["malformed"],
        "query_errors": status["queries"]["errors"],
    }  # fmt: skip


def _pace(client: Client, duration_s: float) -> dict[str, float]:
    """The honest client: one point at a time, at a steady rate."""
    taken_us = []
    failed = 0
    start = time.perf_counter()
    for k in range(max(1, int(duration_s * _PACE_HZ))):
        due = start + k / _PACE_HZ
        if (rest := due - time.perf_counter()) > 0.0:
            time.sleep(rest)
        begin = time.perf_counter()
        try:
            client.point(20.0 + (k % 50), model="linear")
        except DehystError:
            failed += 1
        taken_us.append(1e6 * (time.perf_counter() - begin))
    return {"count": len(taken_us), "failed": failed, "p99_us": float(np.percentile(taken_us, 99.0))}


def fire(endpoint: str, duration_s: float, rate_hz: float, seed: int, bad: bool) -> int:
    """Send queries, requests and samples in turns at ``rate_hz``; wait for the reply to every query."""
    rng = np.random.default_rng(seed)
    keys = Keys(_STAGE, _AXIS)
    aims = [("feedforward", "query"), ("operate", "operate"), ("sample", "samples"), ("feedforward", "query")]
    honest = {name: seeds(name) for name in ("query", "operate", "samples")}
    fired = refused = unanswered = 0
    with open_client(endpoint, 10.0) as session:
        time.sleep(0.5)
        print("ready", flush=True)
        start = time.perf_counter()
        while (due := start + fired / rate_hz) < start + duration_s:
            if (rest := due - time.perf_counter()) > 0.0:
                time.sleep(rest)
            elif time.perf_counter() - start > duration_s:
                break
            what, target = aims[fired % len(aims)] if bad else ("feedforward", "query")
            payload = honest[target][fired % len(honest[target])] if bad else honest["query"][0]
            if bad:
                payload = mutated(payload, rng)
                if fired % _OVERSIZED_EVERY == 0:
                    payload = payload[:8] + bytes(2**20)
            fired += 1
            if what == "sample":
                session.put(keys.sample, payload, congestion_control=SURELY)
                continue
            replies = list(session.get(f"{keys.base}/{what}", payload=payload, timeout=10.0))
            unanswered += len(replies) != 1
            refused += sum(reply.err is not None for reply in replies)
    print(json.dumps({"fired": fired, "refused": refused, "unanswered": unanswered}), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(fire(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]), sys.argv[5] == "bad"))
