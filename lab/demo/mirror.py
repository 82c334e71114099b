"""``dehyst demo --mirror``: a mirror of many actuators flattens a moving wavefront, all axes learning as one batch.

Two mirrors of one seed follow the same wavefront. One is driven by the model that was identified on a single actuator,
the other by a fleet that starts from it and learns every axis from its own sensor. In the last third one actuator of
both keeps its stroke.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from dehyst.adaptive.fleet.fleet import Fleet, FleetConfig
from dehyst.adaptive.identification import IdentifyConfig, identify_lssvm
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.config import LearnerConfig
from dehyst.adaptive.types import FloatArray
from dehyst.service.reports.plot_style import figure, label, legend, line, save
from dehyst.sim.mirror import Mirror, MirrorConfig, Wavefront
from dehyst.sim.signals.voltages import training_input

WINDOW: Final = 60
#: Voltage in the middle, V; amplifiers' limits, V; samples between two snapshots; ramp from rest, s.
_MIDDLE_V, _LOW_V, _HIGH_V, _EVERY, _RAMP_S = 5.0, 0.0, 10.0, 20, 0.3
_NAMES: Final = {"identified": "the model of one actuator", "fleet": "fleet, each axis learning"}


@dataclass(slots=True)
class _Arm:
    """One of the two mirrors: its state, hysteresis memory (B, m), and (n, B) errors of its surface, µm."""

    mirror: Mirror
    memory: FloatArray
    errors_um: FloatArray
    state: Any = field(init=False)

    def __post_init__(self) -> None:
        self.state = self.mirror.initial_state()


def identify_actuator(config: MirrorConfig) -> LssvmInverse:
    """The model of an actuator without spread, from the chapter's training signal."""
    one = Mirror(
        MirrorConfig(side=2, dt_s=config.dt_s, gain_spread=0.0, hysteresis_spread=0.0, noise_um=config.noise_um)
    )
    u = training_input(config.dt_s, 10.0)[1].clip(_LOW_V, _HIGH_V)
    state, y = one.initial_state(), np.empty(u.size)
    for k in range(u.size):
        y[k] = one.read(state)[0]
        one.step(state, np.full(4, u[k]))
    return identify_lssvm(u, y, config.dt_s, config=IdentifyConfig(n=WINDOW, tune=False, gamma=1e3))[0]


def run(out: Path, config: MirrorConfig, duration_s: float, say: Callable[[str], None]) -> dict[str, Any]:
    """Run, write ``mirror.json``, ``mirror.png`` and ``worst.png`` into ``out``; returns the summary."""
    out.mkdir(parents=True, exist_ok=True)
    dt, mirror, n = config.dt_s, Mirror(config), round(duration_s / config.dt_s)
    model = identify_actuator(config)
    begin = time.perf_counter()
    fleet = Fleet([model] * config.actuators, FleetConfig(LearnerConfig(window=WINDOW)))
    start_s = time.perf_counter() - begin
    say(f"identified one actuator; a fleet of {config.actuators} axes started in {start_s:.1f} s")
    t_s: FloatArray = dt * np.arange(n + 2, dtype=np.float64)
    ramp = np.minimum(1.0, t_s / _RAMP_S)[:, None]
    middle_um = _MIDDLE_V * config.stroke_um_per_V
    wave = mirror.strokes(Wavefront(config.side, seed=config.seed + 1).at(t_s))
    wanted = ramp * (middle_um + wave)
    surface = wanted @ mirror.influence.T
    v, a = np.gradient(wanted, dt, axis=0), np.gradient(np.gradient(wanted, dt, axis=0), dt, axis=0)
    first = fleet.snapshot()
    arms = {name: _Arm(mirror, first.rest_memory(), np.zeros((n, config.actuators))) for name in _NAMES}
    dies, dead = 2 * n // 3, config.actuators // 2 + config.side // 3
    newest, steps = first, np.zeros(n)
    for k in range(n):
        if k == dies:
            for arm in arms.values():
                mirror.kill(arm.state, dead)
        for name, arm in arms.items():
            readings = mirror.read(arm.state)
            arm.errors_um[k] = mirror.influence @ arm.state.stroke_um - surface[k]
            # The voltage of this sample makes the stroke of the next.
            points = (wanted[k + 1][:, None], v[k + 1][:, None], a[k + 1][:, None])
            said = (newest if name == "fleet" else first).feedforward(*points, arm.memory)
            arm.memory = said.memory
            u = said.u_V[:, 0].clip(_LOW_V, _HIGH_V)
            if name == "fleet":
                before = time.perf_counter()
                fleet.step(k, k * dt, u, readings)
                steps[k] = time.perf_counter() - before
                if k % _EVERY == _EVERY - 1:
                    newest = fleet.snapshot()
            mirror.step(arm.state, u)
        if k % 500 == 499:
            rms = {name: _rms(arm.errors_um[k - 99 : k + 1]) for name, arm in arms.items()}
            say(f"t = {(k + 1) * dt:.1f} s: surface error {1e3 * rms['identified']:.1f} nm rms with the model of one "
                f"actuator, {1e3 * rms['fleet']:.1f} nm with the fleet")  # fmt: skip
    summary = _summary(config, arms, fleet, dies, dead, steps, start_s)
    (out / "mirror.json").write_text(json.dumps(summary, indent=1), encoding="utf-8")
    _draw_maps(out / "mirror.png", config, arms, dies)
    _draw_worst(out / "worst.png", config, arms, dies, dead)
    return summary


def _rms(errors_um: FloatArray) -> float:
    return float(np.sqrt(np.mean(errors_um**2)))


def _parts(n: int, dies: int) -> dict[str, slice]:
    """Samples of which the errors are stated: the end of the time before an actuator dies, and of all."""
    return {"learnt": slice(dies - dies // 4, dies), "dead": slice(n - (n - dies) // 2, n)}


def _summary(
    config: MirrorConfig, arms: dict[str, _Arm], fleet: Fleet, dies: int, dead: int, steps: FloatArray, start_s: float
) -> dict[str, Any]:
    parts = _parts(steps.size, dies)
    # Beyond the reach of the dead actuator's influence function.
    far = np.abs(Mirror(config).influence[dead]) < 1e-6
    figures = {
        name: {
            **{f"{part}_rms_nm": 1e3 * _rms(arm.errors_um[where]) for part, where in parts.items()},
            "worst_learnt_rms_nm": 1e3 * float(np.sqrt((arm.errors_um[parts["learnt"]] ** 2).mean(0)).max()),
            "far_from_dead_rms_nm": 1e3 * _rms(arm.errors_um[parts["dead"]][:, far]),
            "at_dead_rms_nm": 1e3 * _rms(arm.errors_um[parts["dead"]][:, dead]),
        }
        for name, arm in arms.items()
    }
    return {
        "actuators": config.actuators, "duration_s": steps.size * config.dt_s, "start_up_s": start_s,
        "step_ms": {"median": 1e3 * float(np.median(steps)), "p99": 1e3 * float(np.percentile(steps, 99))},
        "dead_actuator": dead, "troubles": {str(axis): name for axis, name in fleet.troubles().items()},
        "surface_error": figures,
    }  # fmt: skip


def _draw_maps(path: Path, config: MirrorConfig, arms: dict[str, _Arm], dies: int) -> None:
    """Maps of the rms error of the surface, by actuator: before and after learning, and with a dead actuator."""
    n = arms["fleet"].errors_um.shape[0]
    parts = _parts(n, dies)
    maps = [
        ("Model of one actuator", arms["identified"].errors_um[parts["learnt"]]),
        ("Fleet, learnt", arms["fleet"].errors_um[parts["learnt"]]),
        ("Fleet, one actuator dead", arms["fleet"].errors_um[parts["dead"]]),
    ]
    drawn, axes = figure(1, 3, (13.0, 4.6), "Rms error of the surface at each actuator")
    values = [1e3 * np.sqrt((errors**2).mean(0)).reshape(config.side, config.side) for _, errors in maps]
    top = float(np.percentile(values[0], 99))
    for axis, (title, errors), value in zip(np.ravel(axes), maps, values, strict=True):
        image = axis.imshow(value, vmin=0.0, vmax=top, cmap="viridis")
        axis.grid(False)
        label(axis, "actuator", "actuator", f"{title}: {1e3 * _rms(errors):.0f} nm rms")
    drawn.colorbar(image, ax=list(np.ravel(axes)), label="nm rms", shrink=0.85)
    save(drawn, path)


def _draw_worst(path: Path, config: MirrorConfig, arms: dict[str, _Arm], dies: int, dead: int) -> None:
    """The surface's error over time: of all actuators, and of the worst."""
    drawn, axes = figure(2, 1, (10.0, 6.4), "Error of the surface over time", sharex=True)
    axes = np.ravel(axes)
    for name, arm in arms.items():
        blocks = arm.errors_um.shape[0] // 50
        square = (arm.errors_um[: blocks * 50] ** 2).reshape(blocks, 50, -1).mean(1)
        t_s = (np.arange(blocks) + 0.5) * 50 * config.dt_s
        others = np.delete(square, dead, axis=1)
        colour = {"identified": "tab:orange", "fleet": "tab:blue"}[name]
        line(axes[0], t_s, 1e3 * np.sqrt(square.mean(1)), color=colour, label=_NAMES[name])
        line(axes[1], t_s, 1e3 * np.sqrt(others.max(1)), color=colour, label=f"{_NAMES[name]}, all but the dead one")
        line(
            axes[1],
            t_s,
            1e3 * np.sqrt(square[:, dead]),
            color=colour,
            linestyle=":",
            label=f"the one that dies, {name}",
        )
    for axis, title in zip(axes, ("All actuators, rms", "Worst actuator, rms of 50 ms"), strict=True):
        axis.axvline(dies * config.dt_s, color="0.4", linewidth=1.0)
        axis.set_yscale("log")
        label(axis, "time, s", "nm", title)
        legend(axis)
    save(drawn, path)
