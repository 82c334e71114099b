"""Readings that lie, samples that stop, a learner that hangs, a model gone bad, a stage that dies: to real processes.

The service falls back on the last good model, then on the baseline, says so in status and answers, and comes back by
itself; every voltage that leaves meanwhile is finite, within its limits and within its slew.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from dehyst.service.client.client import Client
from dehyst.service.identification.identifying import identify_one
from dehyst.service.protocol import samples as wire
from dehyst.service.protocol.query import BLENDED, NOT_FINITE_REPLACED, STALE, STAND_IN, Trajectory
from dehyst.service.runtime.session import SURELY, open_client, wait_followed
from dehyst.service.stage_node.faults import fault_key
from dehyst.service.stage_node.node import status_key
from dehyst.service.storage.model_file import BundleMeta, write_bundle
from dehyst.sim.signals.voltages import training_input
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage
from tests.service.conftest import unused_port
from tests.service.living import Process

# Alone: a service that lags behind its samples by 0.3 s rightly tells so, and the baseline stands in.
pytestmark = [pytest.mark.e2e, pytest.mark.slow, pytest.mark.alone]
DT_S = 1e-3
SERVED, BASELINE = "lssvm_adaptive", "linear"
U_MIN_V, U_MAX_V, SLEW_V_PER_S = -2.0, 10.0, 4000.0
#: How long a fault lasts: the last good model is served for a second, the baseline takes over within another.
FAULT_S = 3.0
#: How long the service may take to come back once the fault is over.
BACK_S = 15.0
WANTED_UM = 40.0 + 2.0 * np.sin(2 * np.pi * 5.0 * DT_S * np.arange(20))
#: Loaded before anything else: while the one file is there, what is learnt is forty times too much; while the other
#: one is, the learner does not return.
ILL = """
import os, time
from dataclasses import replace
from dehyst.adaptive.online.learner import Learner
_snapshot = Learner.snapshot
def snapshot(self):
    while os.path.exists({hung!r}):
        time.sleep(0.01)
    model = _snapshot(self)
    return replace(model, beta=40.0 * model.beta) if os.path.exists({ill!r}) else model
Learner.snapshot = snapshot
"""
Look = tuple[dict[str, Any], Trajectory]


def identified(path: Path) -> Path:
    """A baseline and what learns, identified on the stage that the processes simulate."""
    stage = Stage(preset("rich", dt_s=DT_S, seed=20))
    u_V = training_input(DT_S, 10.0)[1]
    y_um = stage.run(stage.initial_state(), u_V)[0]
    models = {name: identify_one(name, u_V, y_um, DT_S, 200) for name in (BASELINE, SERVED)}
    write_bundle(path, models, BundleMeta("demo", "x", DT_S, y_min_um=float(y_um.min()), y_max_um=float(y_um.max())))
    return path


class World:
    """A service and a stage as processes, a client that looks at the service, and what it tells of events."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"tcp/127.0.0.1:{unused_port()}"
        #: While they are there, what is learnt is forty times too much, and the learner does not return.
        self.ill, self.hung = folder / "ill", folder / "hung"
        (folder / "path").mkdir()
        (folder / "path" / "sitecustomize.py").write_text(ILL.format(ill=str(self.ill), hung=str(self.hung)))
        model, config = identified(folder / "x.npz"), folder / "serve.toml"
        config.write_text(
            # A machine that stalls for a second is not what is tested here.
            f'stage = "demo"\nlisten = ["{self.endpoint}"]\nlease_s = 10.0\n'
            f'[[axis]]\nname = "x"\nmodel = {json.dumps(str(model))}\n'
            f"u_min_V = {U_MIN_V}\nu_max_V = {U_MAX_V}\nslew_V_per_s = {SLEW_V_PER_S}\n"
            f'served = "{SERVED}"\nstale_s = 0.3\nlast_good_s = 1.0\n'
        )
        self.events: list[str] = []
        self.processes = [Process("serve", "--config", str(config), path=folder / "path")]
        self.session: zenoh.Session = open_client(self.endpoint, 20.0)
        self.client = Client.connect(self.endpoint, timeout_s=2.0, wait_s=20.0, retry_s=20.0)
        self.session.declare_subscriber(self.client.keys.event, self._told)
        #: How many samples or readings each fault has hit, as the stage tells once a second.
        self.hit: dict[str, int] = {}
        self.session.declare_subscriber(status_key("demo", "x"), self._hit)
        self.commands = self.session.declare_publisher(self.client.keys.command, congestion_control=SURELY)
        self.stage = self.start_stage()

    def _told(self, sample: zenoh.Sample) -> None:
        event = json.loads(sample.payload.to_bytes())["event"]
        # Which of the models is the best, and whether the stage has changed, are other matters.
        if not event.startswith(("champion", "diagnosis")):
            self.events.append(event)

    def _hit(self, sample: zenoh.Sample) -> None:
        self.hit = json.loads(sample.payload.to_bytes())["faults"]

    def start_stage(self) -> Process:
        """A stage that counts from 0 and takes faults."""
        process = Process("stage", "--endpoint", self.endpoint, "--batch", "5", "--seed", "21", "--inject")
        self.processes.append(process)
        # A session sends nothing to a stage that it has not heard of yet.
        assert wait_followed(self.commands, 20.0)
        self.drive(0)
        return process

    def drive(self, first: int) -> None:
        """Command voltages that swing over most of the stage's range, for a minute from sample ``first`` on."""
        for seq in range(first, first + 60_000, 1000):
            t_s = DT_S * np.arange(seq, seq + 1000)
            u_V = 3.5 * (1.0 - np.cos(2 * np.pi * 0.9 * t_s)) + 0.3 * np.sin(2 * np.pi * 7.0 * t_s)
            block = wire.encode_command(seq, u_V)
            self.commands.put(block)

    def of_trouble(self) -> list[str]:
        """The events but those of age, which a machine that stalls makes at any time."""
        return [event for event in self.events if event not in ("stale", "fresh")]

    def hurt(self, fault: str) -> None:
        """Have the stage suffer, and wait until it does."""
        self.until(lambda s, a: fault in self.hit, 5.0, "the stage tells of itself")
        before = self.hit[fault]
        self.session.put(fault_key("demo", "x"), json.dumps({"fault": fault, "duration_s": FAULT_S}))
        until = time.monotonic() + FAULT_S
        while self.hit[fault] == before and time.monotonic() < until:
            time.sleep(0.005)
        assert self.hit[fault] > before

    def look(self) -> Look:
        """A status and an answer, which is checked: whatever happens inside, a voltage that leaves is safe to apply."""
        status, answer = self.client.status(), self.client.trajectory(WANTED_UM)
        assert np.isfinite(answer.u_V).all()
        assert (answer.u_V >= U_MIN_V).all()
        assert (answer.u_V <= U_MAX_V).all()
        assert np.max(np.abs(np.diff(answer.u_V))) <= SLEW_V_PER_S * DT_S * (1.0 + 1e-9)
        assert answer.model == SERVED
        return status, answer

    def until(self, condition: Callable[[dict[str, Any], Trajectory], bool], within_s: float, what: str) -> list[Look]:
        """All looks up to the first of which ``condition`` is true; fails after ``within_s``."""
        looks, end = [self.look()], time.monotonic() + within_s
        while not condition(*looks[-1]):
            status, answer = looks[-1]
            told = {name: status[name] for name in ("trouble", "trust", "stale", "seq")}
            assert time.monotonic() < end, f"not in {within_s:g} s: {what}; {told}, flags {np.unique(answer.flags)}"
            time.sleep(0.02)
            looks.append(self.look())
        return looks

    def begin(self) -> None:
        """Let it learn, until the learner answers alone."""
        self.until(lambda s, a: s["samples"]["learnt"] > 1000 and own(s, a), 30.0, "the learner serves")
        self.drive(self.client.status()["seq"])
        self.events.clear()

    def falls_back(self, is_told: Callable[[dict[str, Any]], bool]) -> None:
        """It tells what is wrong and serves the last good model, then the baseline stands in, named and flagged."""
        looks = self.until(lambda s, a: is_told(s), FAULT_S, "it is told")
        looks = looks[-1:] + self.until(lambda s, a: stands_in(a), FAULT_S, f"{BASELINE} stands in")
        assert all(is_told(status) for status, _ in looks)
        alone = [status for status, a in looks if not (a.flags & (STAND_IN | BLENDED)).any()]
        assert alone, "the last good model was served before"
        # One change is allowed: to the learner's own model, once it has gone back to before a fault of the sensor.
        changes = [a["fingerprint"] != b["fingerprint"] for a, b in pairwise(alone)]
        assert sum(changes) <= 1, "and was not taught any more"
        self.until(lambda s, a: s["answering"] == "stand_in", FAULT_S, "the status says so")
        # It stays so for as long as it is wrong, or nearly: the fault began a little before its effect.
        assert is_told(self.look()[0])

    def comes_back(self) -> None:
        """By itself, in bounded time, and learns again."""
        self.until(own, FAULT_S + BACK_S, "the learner serves again")
        learnt = self.client.status()["samples"]["learnt"]
        self.until(lambda s, a: s["samples"]["learnt"] > learnt + 100 and own(s, a), BACK_S, "it learns again")

    def close(self) -> None:
        self.client.close()
        self.session.close()  # type: ignore[no-untyped-call]
        for process in reversed(self.processes):
            process.kill()


def own(status: dict[str, Any], answer: Trajectory) -> bool:
    """Whether the learner answers alone, and nothing is wrong."""
    odd = (answer.flags & (STAND_IN | BLENDED | STALE | NOT_FINITE_REPLACED)).any() or answer.stand_in
    return not (odd or answer.fallback or status["trouble"] or status["stale"])


def stale_with_nothing_to_learn(status: dict[str, Any]) -> bool:
    """Whether no samples come, and those that had come are learnt."""
    return bool(status["stale"] and not status["samples"]["waiting"])


def stands_in(answer: Trajectory) -> bool:
    """Whether the baseline answers in its place, and says so."""
    return bool((answer.flags & STAND_IN).all()) and answer.stand_in == BASELINE and answer.fallback


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(tmp_path_factory.mktemp("world"))
    yield made
    made.close()


def test_samples_that_lie(world: World) -> None:
    world.begin()
    world.hurt("nan")
    world.falls_back(lambda s: s["trouble"] == "samples_poisoned")
    world.comes_back()
    assert world.of_trouble() == ["trouble", "learner_went_back", "recovered"]


def test_samples_that_stop(world: World) -> None:
    world.begin()
    world.hurt("gap")
    world.falls_back(stale_with_nothing_to_learn)
    assert (world.look()[1].flags & STALE).all()
    world.comes_back()
    assert {"stale", "fresh"} <= set(world.events)
    assert world.of_trouble() == []


def test_a_learner_that_hangs(world: World) -> None:
    """Samples come, and nothing is made of them: what is served is as old as if none came."""
    world.begin()
    world.hung.touch()
    world.falls_back(lambda s: s["stale"] and s["samples"]["waiting"] > 0)
    assert (world.look()[1].flags & STALE).all()
    world.hung.unlink()
    world.comes_back()
    assert {"stale", "fresh"} <= set(world.events)
    assert world.client.status()["samples"]["dropped"] == 0


def test_a_model_gone_bad(world: World) -> None:
    world.begin()
    world.ill.touch()
    world.falls_back(lambda s: s["trouble"] == "model_bad")
    world.ill.unlink()
    world.comes_back()
    assert world.of_trouble() == ["trouble", "recovered"]


def test_a_stage_that_is_killed_and_started_again(world: World) -> None:
    world.begin()
    before = world.client.status()
    world.stage.kill()
    world.falls_back(stale_with_nothing_to_learn)
    # The new one counts from 0, is taken up all the same, and taught from.
    world.start_stage()
    world.comes_back()
    after = world.client.status()
    assert (before["samples"]["restarts"], after["samples"]["restarts"]) == (0, 1)
    assert after["instance"] == before["instance"]
    assert {"stale", "fresh", "stage_restarted"} <= set(world.events)
