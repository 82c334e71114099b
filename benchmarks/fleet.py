"""A fleet beside a loop of single learners and beside naive batched ``torch.linalg.solve``, in one run.

``python -m benchmarks.fleet [--axes 64 256 1024] [--window 100] [--learn-every 10] [--device cuda] [--steps 200]``

The single learners run on one core, the fleet on ``--threads``: the ratio is what a service gains on that machine.
For each number of axes: time of a step of all axes (median, p99), the same of as many single learners one after the
other (measured on at most 64 of them, times the number of axes), and of solving all kernel matrices anew with
``torch.linalg.solve``, which a step of all windows replaces; evaluation of all axes at one point; start-up; memory; and
the bytes of the inverses that a step of all windows must read and write (one triangle each), over the bandwidth of a
copy of a large array and of one that is changed in place. All axes have the same model, each with a gain of its own.
Processor times (all threads of the process) hold beside other work too; times by the clock do not.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from adaptive.fleet.fleet import Fleet, FleetConfig
from adaptive.identification import IdentifyConfig, identify_lssvm
from adaptive.inverse_model import LssvmInverse
from adaptive.online.config import LearnerConfig
from adaptive.online.learner import Learner
from adaptive.types import FloatArray, Sample
from adaptive.window.window import SolverConfig
from sim.signals.voltages import training_input
from sim.stage.presets import preset
from sim.stage.stage import Stage

DT_S = 1e-3
#: Largest number of single learners that are measured.
MOST_SINGLE = 64


def identified(window: int) -> tuple[LssvmInverse, Stage]:
    """A model with ``window`` support vectors, and its stage."""
    stage = Stage(preset("rich", seed=1))
    _, u = training_input(DT_S, 10.0)
    y, _ = stage.run(stage.initial_state(), u)
    return identify_lssvm(u, y, DT_S, config=IdentifyConfig(n=window, tune=False, gamma=1e3))[0], stage


def recording(stage: Stage, n: int) -> tuple[FloatArray, FloatArray]:
    """(n,) voltages, V, and readings, µm, of a moving stage."""
    t_s = np.arange(n) * DT_S
    tones = ((1.6, 0.7), (1.0, 1.9), (0.6, 4.3), (0.3, 7.7))
    # Without a ramp, whose end would count as a commanded step: the first 50 samples are not learnt anyway.
    u = 4.0 + sum(size * np.sin(2.0 * np.pi * hz * t_s + hz) for size, hz in tones)
    return np.asarray(u), stage.run(stage.initial_state(), u)[0]


def bandwidth(device: str) -> tuple[float, float]:
    """Bytes a second that a copy of 256 MB reads and writes, and a change of 256 MB in place."""
    source = torch.zeros(2**25, dtype=torch.float64, device=device)
    target = torch.empty_like(source)
    copies = [timed(lambda: target.copy_(source), device) for _ in range(7)]
    changes = [timed(lambda: source.add_(1.0), device) for _ in range(7)]
    moved = 2.0 * source.numel() * 8
    return moved / float(np.median(copies)), moved / float(np.median(changes))


def timed(work: Callable[[], object], device: str) -> float:
    """Seconds of one call, the device's work included."""
    begin = time.perf_counter()
    work()
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter() - begin


def naive_s(axes: int, window: int, device: str) -> float:
    """Seconds to solve for all axes anew; on the processor by one thread, measured on 16 of them."""
    # With two threads some builds of MKL fail in batched factorisations of 500 rows, and do not return.
    threads, some = torch.get_num_threads(), min(axes, 16 if device == "cpu" else 128)
    torch.set_num_threads(1)
    points = torch.rand((some, window, 3), dtype=torch.float64, device=device)
    R = torch.exp(-(torch.cdist(points, points) ** 2)) + 1e-3 * torch.eye(window, dtype=torch.float64, device=device)
    right = torch.rand((some, window, 2), dtype=torch.float64, device=device)
    seconds = min(timed(lambda: torch.linalg.solve(R, right), device) for _ in range(3)) * axes / some
    torch.set_num_threads(threads)
    return seconds


def measure(axes: int, args: argparse.Namespace, moved_bytes_s: tuple[float, float]) -> None:
    """Print the lines of one number of axes."""
    form = "inverse" if args.device != "cpu" else args.form
    config = LearnerConfig(window=args.window, learn_every=args.learn_every, solver=SolverConfig(form=form))
    model, stage = identified(args.window)
    gains = 1.0 + 0.1 * np.linspace(-1.0, 1.0, axes)
    models = [replace(model, features=replace(model.features, gain=float(gain))) for gain in gains]
    begin = time.perf_counter()
    fleet = Fleet(models, FleetConfig(config, args.device, args.threads))
    fleet.warm()
    start_s = time.perf_counter() - begin
    u, y = recording(stage, args.before + args.steps)
    singles = [Learner(one, config) for one in models[: min(axes, MOST_SINGLE)]]
    together, alone, apart, stepped = [], [], 0, 0
    worked: list[tuple[float, float]] = []
    for k in range(args.before + args.steps):
        if k == args.before:
            stepped = -sum(fleet.learner_of(axis).counters()["window_steps"] for axis in (0, axes - 1))
        readings = gains * y[k]
        if args.lost and k >= args.before:
            readings[7 * k % axes] = np.nan
        start = time.process_time()
        together.append(timed(lambda k=k, y=readings: fleet.step(k, k * DT_S, u[k], y), args.device))  # type: ignore[misc]
        apart += len(fleet.apart) if k >= args.before else 0
        begin, middle = time.perf_counter(), time.process_time()
        for reading, single in zip(readings, singles, strict=False):
            single.handle(Sample(k, k * DT_S, float(u[k]), float(reading)))
        alone.append((time.perf_counter() - begin) * axes / len(singles))
        worked.append((middle - start, (time.process_time() - middle) * axes / len(singles)))
    stepped += sum(fleet.learner_of(axis).counters()["window_steps"] for axis in (0, axes - 1))
    steps, loops = np.array(together[args.before :]), np.array(alone[args.before :])
    snapshot, memory = fleet.snapshot(), fleet.memory()
    at_um, still = np.full((axes, 1), 20.0), np.zeros((axes, 1))
    answers = [timed(lambda: snapshot.feedforward(at_um, still, still, memory), args.device) for _ in range(20)]
    triangles = axes * args.window * (args.window + 1) / 2 * 8 * 2 / args.learn_every
    solved = naive_s(axes, args.window, args.device) / args.learn_every
    print(f"B = {axes}, N = {args.window}, a window step every {args.learn_every} samples, {args.device}, {form}")
    ms, first = 1e3, np.array(together[: args.before] or [0.0])
    print(f"  start-up {start_s:.2f} s; window matrices {2 * axes * args.window**2 * 8 / 2**20:.0f} MiB")
    print(f"  before        mean {first.mean() * ms:8.2f} ms over the {args.before} samples before, longest "
          f"{first.max() * ms:.0f} (sample {first.argmax()}); first 256: {first[:256].sum():.1f} s")  # fmt: skip
    print(f"  fleet         mean {steps.mean() * ms:8.2f} ms a sample of all axes, median {np.median(steps) * ms:.2f}, "
          f"p99 {np.percentile(steps, 99) * ms:.2f}; {apart / args.steps:.1f} axes apart on average, "
          f"{0.5 * stepped:.0f} window steps of an axis")  # fmt: skip
    print(f"  single x B    mean {loops.mean() * ms:8.2f} ms on one core, {loops.mean() / steps.mean():.2f} times the "
          f"fleet's on {args.threads}")  # fmt: skip
    ours, theirs = np.mean(worked[args.before :], axis=0)
    print(f"  processor     {ours * ms:8.2f} ms, {theirs * ms:.2f} for single x B: {theirs / ours:.2f} times")
    print(f"  solve x B     mean {solved * ms:8.2f} ms for the windows alone, {solved / steps.mean():.1f} times")
    copied_s, changed_s = (triangles / moved for moved in moved_bytes_s)
    print(f"  inverses      {triangles / 1e6:.1f} MB a sample, {copied_s * ms:.2f} ms at a copy's "
          f"{moved_bytes_s[0] / 1e9:.1f} GB/s, {changed_s * ms:.2f} at the {moved_bytes_s[1] / 1e9:.1f} of a change in "
          f"place: {100 * copied_s / steps.mean():.0f} and {100 * changed_s / steps.mean():.0f} % of the fleet's "
          f"time")  # fmt: skip
    print(f"  evaluation    median {np.median(answers) * ms:.2f} ms for one point of all axes", flush=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", type=int, nargs="+", default=[64, 256, 1024], help="numbers of axes")
    parser.add_argument("--window", type=int, default=100, help="samples in each window")
    parser.add_argument("--learn-every", type=int, default=10, help="samples between two steps of the windows")
    parser.add_argument("--device", default="cpu", help="device of torch: cpu or cuda")
    parser.add_argument("--form", default="auto", choices=["auto", "inverse", "cholesky"], help="of the windows")
    parser.add_argument("--threads", type=int, default=2, help="that share the axes of a compiled step")
    parser.add_argument(
        "--before", type=int, default=700, help="samples before the measured; windows learn from 600 on"
    )
    parser.add_argument("--lost", action="store_true", help="in each measured sample one axis, in turn, has no reading")
    parser.add_argument("--steps", type=int, default=200, help="measured samples")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    moved = bandwidth(args.device)
    for axes in args.axes:
        measure(axes, args, moved)


if __name__ == "__main__":
    main()
