"""The report's part on control: Table 2.5, Figs. 2.17 to 2.20, and what adapting is worth."""

from __future__ import annotations

from typing import Any

from lab.reproduce.markdown import number, picture, short, table
from lab.reproduce.study import PresetStudy
from sim.chapter.control import CHANGE_S, FROZEN, GAIN_CHANGE, LEARNING

#: RMS noise of a reading on both stages, µm; the mean size of Gaussian noise is 0.798 of that.
SENSOR_NOISE_UM = 0.005
_ROWS = {"none": "feedback alone", **FROZEN, **{key: label for key, (label, _) in LEARNING.items()}}


def control_section(
    study: PresetStudy, ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]
) -> str:
    """Section 2.5 of the chapter."""
    return "\n".join([_gains(study, ours, published), _table_2_5(ours, published, pictures), _change(ours, pictures)])


def _gains(study: PresetStudy, ours: dict[str, Any], published: dict[str, Any]) -> str:
    gains, theirs = ours["gains"], published["gains"]
    if gains["chapter_gains_stable"]:
        loop = study.control.loop("lssvm_memory", "FF+FB, chapter's gains", study.control.loops[0].reference)
        verdict = (
            "The chapter's gains are below that here and stable; with them FF+FB with memory has a MAE of "
            f"{loop.score.mae_pct:.4f} %."
        )
    else:
        verdict = (
            "The chapter's K_p is above that: on this stage, with its lightly damped mode at 450 Hz, it would "
            "oscillate, and it is not used."
        )
    return "\n".join(
        [
            "## Control: Figs. 2.16 to 2.20, Table 2.5\n",
            "Ziegler and Nichols' experiment on the stage, run by the program at T = 1 ms: ultimate gain "
            f"{gains['ultimate_gain_V_per_um']:.4f} V/µm, period {1e3 * gains['ultimate_period_s']:.2f} ms. Their PI "
            f"gains follow: K_p = {gains['k_p_V_per_um']:.4f} V/µm, K_i = {gains['k_i_V_per_um_s']:.2f} V/(µm s) "
            f"(published: {theirs['K_p']} and {theirs['K_i']}; from these an ultimate gain of 0.192 V/µm and a period "
            "of 3.3 ms). "
            + verdict
            + " K_i is taken as the continuous gain, K_i T e per sample: per sample it would be unstable at 11 µm/V.\n",
        ]
    )


def _table_2_5(ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]) -> str:
    parts = []
    references = list(ours["table_2_5"])
    for name in references:
        found = ours["table_2_5"][name]
        rows = []
        for key, label in _ROWS.items():
            controllers = found.get(key, {})
            cells = [label]
            for controller in ("FB",) if key == "none" else ("FF", "FF+FB"):
                score = controllers.get(controller)
                cells += [number(score["mae_pct"], 4), number(score["rmse_pct"], 4)] if score else ["–", "–"]
            if key == "none":
                cells = [label, "–", "–", *cells[1:]]
            theirs = published["models"].get(key) if name == references[0] else None
            if theirs is not None:
                cells += [number(theirs["feedforward_mae_pct"]), number(theirs["hybrid_mae_pct"])]
            else:
                cells += ["–", "–"]
            rows.append(cells)
        head = [f"Reference {name}", "FF MAE", "FF RMSE", "FF+FB MAE", "FF+FB RMSE", "published FF", "published FF+FB"]
        parts.append(table(head, rows))
        if name == references[0]:
            parts.append("".join(picture(pictures, key, f"Fig. {key}") for key in ("2.17", "2.18", "2.19", "2.20")))
    first = ours["table_2_5"][references[0]]
    memory, two, feedback = first["lssvm_memory"], first["lssvm"], first["none"]["FB"]
    times = ", ".join(f"{FROZEN[key]} {seconds:.2f} s" for key, seconds in ours["inverse_seconds"].items())
    parts.append(
        f"Frozen models are those identified from the 10 s of (2.37) at 1 ms ({times}). Learning ones start from them "
        "at rest and learn along the reference they are judged on: voltages of 20 ms are answered by a snapshot that "
        "has seen no sample of the last 40 ms.\n"
    )
    parts.append(
        "The references in µm go back to 0 again and again, below the few µm to which the training record returns by "
        "itself: a model whose inputs are (y, dy/dt) has learnt no voltage for that and holds the stage where its "
        "samples end. Models with memory carry on. That, the plain sine and the minor loops are what the chapter's "
        "own test does not ask for.\n"
    )
    noise_pct = 100.0 * 0.798 * SENSOR_NOISE_UM / ours["range_um"]
    parts.append(
        f"On the first reference, feedforward with memory alone ({memory['FF']['mae_pct']:.4f} %) beats feedback "
        f"alone ({feedback['mae_pct']:.4f} %) by {feedback['mae_pct'] / memory['FF']['mae_pct']:.1f} times and the "
        f"two-input LSSVM ({two['FF']['mae_pct']:.3f} %) by {two['FF']['mae_pct'] / memory['FF']['mae_pct']:.0f} "
        f"times; with feedback {memory['FF+FB']['mae_pct']:.4f} % remain. Errors are those of the readings: the "
        f"sensor's noise alone is {noise_pct:.4f} % of them, and feedback cannot take it out but only add to it. As "
        "the chapter says, the feedforward carries the control signal and the feedback what is left. Adapting pays "
        "with feedforward alone; with feedback on a stage that does not change it brings nothing.\n"
    )
    return "\n".join(parts)


def _change(ours: dict[str, Any], pictures: dict[str, str]) -> str:
    found = ours["after_gain_change"]
    rows = [[_ROWS[key], number(score["mae_pct"], 4), short(score["max_um"])] for key, score in found.items()]
    return "\n".join(
        [
            "## When the stage changes\n",
            f"Feedforward alone on the last reference, while the gain of the stage drops by {-100 * GAIN_CHANGE:g} % "
            f"at {CHANGE_S:g} s; errors from one second after it on.\n",
            table(["model", "MAE, %", "max / µm"], rows),
            picture(pictures, "change", "gain change"),
            "All frozen models are lost to the change, whatever their accuracy was before it. All that "
            "learn come back: the tracking filter to Bouc-Wen's own accuracy, recursive least squares on the many "
            "weights of MPI to about its, the adaptive LSSVM to hundredths of a per cent.\n",
        ]
    )
