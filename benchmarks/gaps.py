"""Errors after a gap in the samples, beside the same learner without the gap.

    python -m benchmarks.gaps

Five stages (the demonstration's, and one of each kind of hysteresis of the foreign stages) at 1 kHz, two motions
(multitone; a sine of 2 Hz), five places of the gap. The learner knows the stage from 10 s of identification and at
least 4 s of learning. Every five points are asked for at the sample before them, with the memory that the learner
tracks. Errors in percent of the voltage span.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from adaptive.identification import IdentifyConfig, identify_lssvm
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, Sample
from service.identification.identifying import motion_of
from sim.recordings import Recording
from sim.signals.voltages import multitone, training_input
from sim.stage.presets import preset
from sim.stage.stage import Stage
from tests.foreign.plants import HYSTERESIS, random_plant, with_traits

DT_S, EVERY = 1e-3, 5
PLACES = (4000, 5300, 6130, 7410, 8250)
LENGTHS = (60, 300, 500, 1000)
#: Windows after the gap, samples.
WINDOWS = ((0, 50), (50, 200), (200, 500), (500, 1000), (1000, 1500))

Simulate = Callable[[FloatArray], FloatArray]


def stages() -> Iterator[tuple[str, Simulate]]:
    """Name and simulation (voltages of 0 to 8 V to readings, µm) of each stage."""
    rich = Stage(preset("rich", seed=4))
    yield "demo", lambda u_V: rich.run(rich.initial_state(), u_V)[0]
    for kind in HYSTERESIS:
        factory = next(random_plant(seed) for seed in range(200) if random_plant(seed).traits.hysteresis == kind)
        quiet = with_traits(
            factory, dt_s=DT_S, u_min_V=0.0, u_max_V=8.0, range_um=80.0, offset_um=0.0, modes=(), noise_um=0.004
        )
        yield kind, lambda u_V, make=quiet: make().run(u_V)[0]


def motions() -> Iterator[tuple[str, FloatArray]]:
    """Name and voltages of each motion."""
    n = PLACES[-1] + LENGTHS[-1] + 2000
    rise = np.minimum(np.arange(n) / 500.0, 1.0)
    yield "multitone", rise * multitone(n * DT_S, DT_S, seed=4)[1][:n]
    yield "sine", rise * (4.0 - 1.4 * np.cos(2 * np.pi * 2.0 * np.arange(n) * DT_S))


class Course:
    """A stage in motion, and a learner's answers along it."""

    def __init__(self, u_V: FloatArray, y_um: FloatArray) -> None:
        self.u_V, self.y_um = u_V, y_um
        self.motion = motion_of(Recording(np.arange(u_V.size) * DT_S, u_V, y_um, DT_S))
        self.percent = 100.0 / float(np.ptp(u_V))

    def answers(self, learner: Learner, first: int, stop: int) -> tuple[FloatArray, FloatArray]:
        """(errors, deviations) in % of the span for samples ``first`` to ``stop``; NaN for the first."""
        error, std = np.full((2, stop), np.nan)
        for k in range(first, stop):
            learner.handle(Sample(k, k * DT_S, float(self.u_V[k]), float(self.y_um[k])))
            memory = learner.memory_for(learner.snapshot()) if (k - first) % EVERY == 0 else None
            if memory is not None:
                due = slice(k + 1, min(k + 1 + EVERY, stop))
                y, v, a = (np.ascontiguousarray(self.motion[due, i]) for i in range(3))
                forward = learner.snapshot().feedforward(y, v, a, memory)
                error[due], std[due] = np.abs(forward.u_V - self.u_V[due]), forward.std_V
        return error[first:] * self.percent, std[first:] * self.percent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.parse_args()
    print("after the gap, samples:  " + "  ".join(f"{a}-{b}" for a, b in WINDOWS))
    training_V = training_input(DT_S, 10.0)[1]
    training_V *= 8.0 / training_V.max()
    for stage, simulate in stages():
        for name, u_V in motions():
            y_um = simulate(np.concatenate([training_V, u_V]))
            config = IdentifyConfig(n=150, tune=False)
            base = identify_lssvm(training_V, y_um[: training_V.size], DT_S, config=config)[0]
            course = Course(u_V, y_um[training_V.size :])
            whole, states, at = Learner.from_model(replace(base, name="lssvm_adaptive")), {}, 0
            usual = np.empty(0)
            for place in (*PLACES, u_V.size):
                usual = np.concatenate([usual, course.answers(whole, at, place)[0]])
                states[place], at = whole.state_dict(), place
            for missing in LENGTHS:
                report(stage, name, missing, course, usual, states)


def report(stage: str, name: str, missing: int, course: Course, usual: FloatArray, states: dict[int, dict]) -> None:
    """One line: mean errors by window, the largest, the share within the deviation, and the ratio after a second."""
    errors, inside, ratio = [], [], []
    for place in PLACES:
        first = place + missing
        error, std = course.answers(Learner.from_state(states[place]), first, first + WINDOWS[-1][1])
        errors.append(error)
        inside.append((error <= std)[:200][np.isfinite(error[:200])].mean())
        late = slice(*WINDOWS[-1])
        ratio.append(np.nanmean(error[late]) / np.nanmean(usual[first + late.start : first + late.stop]))
    means = "  ".join(f"{np.nanmean(np.array(errors)[:, a:b]):6.3f}" for a, b in WINDOWS)
    print(
        f"{stage:9s} {name:9s} {missing:5d} missing  {means}   largest {np.nanmax(errors):5.2f}   within the deviation "
        f"{100 * np.mean(inside):5.1f} %   after 1 s x {np.mean(ratio):4.2f} (worst {max(ratio):4.2f})",
        flush=True,
    )


if __name__ == "__main__":
    main()
