"""``dehyst replay``: run the learner over a recording, offline, to see what it would do live.

For every block of samples, the model predicts the voltage as a controller would get it (--age s old), then learns the
block. Errors are of the voltage for the measured motion: in V, in percent of the voltage span of identification, and in
µm by the mean gain. The code is the same as live, and so are the snapshots.

The configuration is that of 'dehyst serve', or the learner's settings alone (docs/learner.md):

  window = 500
  [drift]
  gain_walk = 0.03

  dehyst replay recordings/x --config serve.toml --out out/replay
  dehyst replay test.csv --config learner.toml --model stage.npz --sensor-late 1 --out out/replay

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dehyst.service.cli.options import add_shared, check_number, progress_printer
from dehyst.service.identification.recording_options import add_mapping_arguments, describe, load
from dehyst.service.protocol.errors import FieldError

if TYPE_CHECKING:
    from dehyst.service.config.learner import LearnerSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst replay``."""
    add = parser.add_argument
    add("data", type=Path, metavar="RECORDING", help="the recording: a file, or a folder of segments")
    add("--config", type=Path, required=True, metavar="FILE", help="TOML of 'dehyst serve', or of the learner alone")
    add_shared(parser, axis={"default": None, "help": "axis of the configuration (its only one)"})
    add("--model", type=Path, metavar="MODEL.npz", help="model to start from (the configuration's)")
    add("--learn", metavar="NAME", help="which model of the file learns (the configuration's, or lssvm_adaptive)")
    add_shared(parser, "range")
    add("--age", type=float, default=0.06, metavar="S", help="age of the model when its answer takes effect, s (0.06)")
    add("--window", type=float, default=0.5, metavar="S", help="window of the mean error in the picture, s (0.5)")
    add_shared(parser, "no-pictures", "quiet", "json")
    add_shared(parser, out={"required": True, "help": "folder for JSON, every decision, pictures and the model"})
    add_mapping_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Read, replay, score, write. Returns 0."""
    from dehyst.adaptive.inverse_model import LssvmInverse
    from dehyst.service.background.adoptions import read_adoptions
    from dehyst.service.config.learner import read_learner_settings
    from dehyst.service.replay import axis_config, draw_errors, draw_gates, replay, summary, write_gates
    from dehyst.service.server.axis_loading import load_axis
    from dehyst.service.server.learner_supervisor import standing_of
    from dehyst.service.storage.model_file import read_bundle, write_bundle
    from dehyst.service.storage.output import clear_output

    say = progress_printer(args.quiet)
    check_number("--window", args.window, "s", low=0, above=True)
    found: LearnerSettings = read_learner_settings(args.config, args.axis)
    path = args.model if args.model is not None else found.axis.model if found.axis is not None else None
    if path is None:
        raise FieldError("--model", "nothing", f"a model file, as {args.config} names none", "see 'dehyst identify'")
    bundle = read_bundle(path)
    config = axis_config(found, path, bundle, args.learn)
    # The user chooses recording and model: names of stage and axis need not match.
    axis = load_axis("replay", config, bundle=replace(bundle, meta=replace(bundle.meta, stage="", axis="")))
    recording = load(args.data, args, args.range)
    say(describe(recording, []))
    if args.data.is_dir():
        # Re-tunings of the time of the recording take effect at the same samples.
        adopted = read_adoptions(args.data)
        axis.adopt_at(*adopted)
        if adopted:
            say(f"  {len(adopted)} re-tunings of the recording are adopted at their samples")
    clear_output(args.out)
    start = time.perf_counter()
    shown = [start]

    def progress(done: int, of: int) -> None:
        now = time.perf_counter()
        if now - shown[-1] > 5.0 or done == of:
            shown.append(now)
            say(f"  {done * axis.dt_s:.0f} of {of * axis.dt_s:.0f} s replayed in {now - start:.0f} s")

    done = replay(recording, axis, args.age, progress)
    seconds = time.perf_counter() - start
    learnt = bundle.models[config.learn]
    span_V = learnt.span_V if isinstance(learnt, LssvmInverse) else 1.0
    numbers: dict[str, Any] = {
        "recording": args.data.name,
        "sha256": recording.sha256,
        "model": path.name,
        "learn": config.learn,
        "settings": found.settings,
        "duration_s": recording.duration_s,
        "seconds": round(seconds, 3),
        "competition": standing_of(axis.learner),
        **summary(done, span_V),
    }
    (args.out / "replay.json").write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    write_gates(args.out / "gates.csv", done)
    write_bundle(args.out / "model.npz", dict(axis.newest.models), bundle.meta)
    if not args.no_pictures:
        draw_errors(args.out / "errors.png", f"{args.data.name}: predicted, then learnt", done, span_V, args.window)
        draw_gates(args.out / "gates.png", args.data.name, done)
    print(json.dumps(numbers) if args.json else table(numbers, args.out))
    return 0


def table(numbers: dict[str, Any], out: Path) -> str:
    """The result as text."""
    lines = [
        f"{numbers['recording']}: {numbers['duration_s']:.4g} s replayed in {numbers['seconds']:.3g} s, "
        f"{numbers['scored']} samples scored; {numbers['learn']} of {numbers['model']} learnt",
        f"{'predicted less applied voltage':<30}{'MAE/mV':>9}{'RMSE/mV':>9}{'max/mV':>9}{'MAE/%':>9}{'RMSE/µm':>9}",
    ]
    for key, label in (("frozen", "as it was identified"), ("adaptive", "learning")):
        s = numbers[key]
        errors = "nothing was scored"
        if s["mae_V"] is not None:
            errors = "".join(f"{1e3 * s[name]:9.2f}" for name in ("mae_V", "rmse_V", "max_V"))
            errors += f"{s['mae_pct']:9.3f}{s['rmse_um']:9.4f}"
        lines.append(f"{label:<30}{errors}")
    stated = numbers["within_stated_std"]
    lines.append(
        f"errors within one stated deviation: {100 * stated['one_std']:.1f} % (68.3 stated), "
        f"within two: {100 * stated['two_std']:.1f} % (95.4 stated)"
    )
    lines.append("samples by what the learner said: " + ", ".join(f"{k} {v}" for k, v in numbers["gates"].items()))
    lines += [f"  repaired for scoring: {line}" for line in numbers["repaired"]]
    lines.append(f"replay.json, gates.csv, errors.png, gates.png and the model at the end, model.npz, are in {out}/")
    return "\n".join(lines)
