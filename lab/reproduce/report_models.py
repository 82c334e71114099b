"""The report's part on characterisation and forward models: Figs. 2.2 to 2.15, Tables 2.1 to 2.4."""

from __future__ import annotations

from typing import Any

from lab.reproduce.markdown import number, picture, short, table
from lab.reproduce.study import PresetStudy
from sim.chapter.control import FROZEN, LEARNING

#: Table 2.4: our model -> the chapter's column.
_PUBLISHED = {"bouc_wen_pso": "bouc_wen", "bouc_wen": "bouc_wen", "mpi_pso": "mpi", "mpi": "mpi", "lssvm": "lssvm"}


def models_section(
    study: PresetStudy, ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]
) -> str:
    """Everything up to Table 2.4."""
    parts = [_characterisation(ours, published, pictures), _parameters(ours, published, pictures)]
    parts += [_lssvm(ours, published, pictures), _table_2_4(study, ours, published), _third(ours, pictures)]
    parts.append(_inverse(ours))
    return "\n".join(parts)


def _characterisation(ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]) -> str:
    found = ours["characterisation"]
    triangles, sines = found["triangles"], found["sines"]
    talk, back = found["cross_talk_pct"], found["cross_talk_back_pct"]
    crossed = (
        f"Cross-talk is {talk:.2f} % from x to y and {back:.2f} % from y to x (published: "
        f"{published['cross_talk_pct']} %)."
        if talk is not None
        else "This stage has one axis, hence no cross-talk."
    )
    rows = [[f"{w['amplitude_V']:g} V", number(w["width_um"], 2), number(w["width_pct"], 2)] for w in triangles]
    more = [[f"{w['frequency_Hz']:g} Hz", number(w["width_um"], 2), number(w["width_pct"], 2)] for w in sines]
    return "\n".join(
        [
            "## Characterisation: Figs. 2.2 and 2.3\n",
            f"The loop widens with amplitude, from {triangles[0]['width_um']:.2f} µm at "
            f"{triangles[0]['amplitude_V']:g} V to {triangles[-1]['width_um']:.2f} µm at "
            f"{triangles[-1]['amplitude_V']:g} V, and with frequency, from {sines[0]['width_um']:.2f} µm at 1 Hz to "
            f"{sines[-1]['width_um']:.2f} µm at 10 Hz, as the chapter says of its stage. {crossed} The width is the "
            "largest distance between both branches at one voltage, so that the lag of mechanics, amplifier and "
            "sensor counts in it: on the stage `bouc_wen` it is all of what grows with frequency, for its hysteresis "
            "(2.2) knows no rate.\n",
            table(["triangle to", "width / µm", "% of its stroke"], rows),
            picture(pictures, "2.2", "Fig. 2.2"),
            table(["sine", "width / µm", "% of its stroke"], more),
            picture(pictures, "2.3", "Fig. 2.3"),
        ]
    )


def _parameters(ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]) -> str:
    found = ours["table_2_1"]
    head = ["Table 2.1", "published", *found]
    rows = [
        [name, short(value), *(short(found[key][name]) for key in found)]
        for name, value in published["table_2_1"].items()
    ]
    for ratio, top in (("m/k, s²", "m"), ("b/k, s", "b")):
        row = [ratio, short(published["table_2_1"][top] / published["table_2_1"]["k"])]
        rows.append(row + [short(found[key][top] / found[key]["k"]) for key in found])
    parts = [
        "## Bouc-Wen and MPI: Figs. 2.8 to 2.10, Tables 2.1 to 2.3\n",
        picture(pictures, "2.8", "Fig. 2.8"),
        table(head, rows),
        "Divided by k, (2.1) shows that a recording sees only m/k and b/k: of m, b and k any multiple is the same "
        "model, and the swarm's are one of them. The least-squares route keeps the chapter's k. The published m/k is "
        "the square of 0.03 ms and does not show at these frequencies; it is set as good as none unless the record "
        "shows it. b/k takes up all that makes the stage late: the half millisecond of a held voltage on both "
        "stages, amplifier, mode and sensor on `rich`.\n",
        picture(pictures, "2.9", "Fig. 2.9"),
        "Bouc-Wen is identified by the chapter's route, a swarm over Table 2.1's search space, and by least squares "
        "from several starts with gain and offset solved for within, which takes a fraction of the time and ends at "
        "the same minimum or lower. It is refined with the voltage known at 1 ms: at 0.02 s the 3 Hz turns of (2.37) "
        "lie between samples.\n",
    ]
    for number_, title, start in (("2_2", "Table 2.2: MPI", ""), ("2_3", "Table 2.3: its inverse", "*")):
        theirs, mine = published[f"table_{number_}"], ours[f"table_{number_}"]["mpi"]
        rows = []
        for i in range(max(len(theirs["r"]), len(mine["r"]))):
            cells = [str(i)]
            for source in (theirs, mine):
                for name in ("r", "w_h", "d", "w_s"):
                    cells.append(short(source[name][i]) if i < len(source[name]) else "")
            rows.append(cells)
        names = [f"{name}{start}" for name in ("r", "w_h", "d", "w_s")]
        head = ["i", *(f"published {name}" for name in names), *(f"ours {name}" for name in names)]
        parts += [
            f"**{title}** (forward: r in V, d in the unit between both operators; inverse: r* in that, d* in µm)\n",
            table(head, rows),
        ]
    parts += [
        "(2.40) is minimised by all weights zero, so that a scale has to be fixed: here the inverse saturation maps "
        "the recorded stroke onto itself. The published weights are the same kind of model at another scale (w_h a "
        "hundred times smaller, w_s0 = 99.9999); their dead zones are of no effect (w_s1 to w_s6 about 1e-4), so "
        "that the published model is a plain PI model. Non-negative least squares has one minimum and needs no "
        "start; the swarm needs more time for very nearly the same.\n",
        picture(pictures, "2.10", "Fig. 2.10"),
    ]
    return "\n".join(parts)


def _lssvm(ours: dict[str, Any], published: dict[str, Any], pictures: dict[str, str]) -> str:
    hyper, theirs = ours["hyper_parameters"], published["hyper_parameters"]
    given = ours["table_2_4"]["lssvm_given"]
    rows = [
        ["published, forward", short(theirs["forward"][0]), short(theirs["forward"][1])],
        ["published, inverse", short(theirs["inverse"][0]), short(theirs["inverse"][1])],
    ]
    for key, found in hyper.items():
        widths = found["sigma"]
        text = short(widths[0]) if max(widths) == min(widths) else ", ".join(short(width) for width in widths)
        rows.append([key, short(found["gamma"]), text])
    return "\n".join(
        [
            "## LSSVM: Figs. 2.11, 2.12\n",
            picture(pictures, "2.11", "Fig. 2.11"),
            table(["hyper-parameters", "gamma", "sigma"], rows),
            "The evidence is maximised from the chapter's own start (gamma 100, sigma 1). It prefers kernels more "
            "than ten times narrower than the published ones. With the published pair on these data the modelling "
            f"MAE is {given['modelling']['mae_pct']:.3f} % and the generalisation MAE "
            f"{given['generalisation']['mae_pct']:.3f} %. Public copies of the toolbox that the chapter used take "
            "exp(-d²/(2 sig2)) for the kernel, scale eigenvalues by N - 1 once too often and run their third level "
            "to the edge of its search, which may be where the published pair comes from.\n",
            "The model with memory has a linear part over its play operators, and the kernel learns what that "
            "leaves. "
            + (
                "Here the evidence puts the kernel away (gamma at the lower bound of its search): nothing is left "
                "that is a function of its inputs. The memory does the work, and the solver's linear part is "
                "enough.\n"
                if hyper["lssvm_memory"]["gamma"] < 0.1
                else "Here the kernel takes part of what is left.\n"
            ),
            picture(pictures, "2.12", "Fig. 2.12"),
        ]
    )


def _table_2_4(study: PresetStudy, ours: dict[str, Any], published: dict[str, Any]) -> str:
    rows = []
    for key, found in ours["table_2_4"].items():
        theirs = published["models"].get(_PUBLISHED.get(key, ""))
        cells = [f"{found['label']}, {found['route']}", f"{found['seconds']:.3f}"]
        for part in ("modelling", "generalisation"):
            cells += [number(found[part]["mae_pct"], 4), number(found[part]["rmse_pct"], 4)]
        cells += [number(found["modelling"]["max_um"], 2), number(found["third_family_mae_pct"])]
        if theirs is not None:
            cells += [short(theirs["identification_s"]), number(theirs["modelling_mae_pct"])]
            cells += [number(theirs["generalisation_mae_pct"]), number(theirs["max_um"], 2)]
        else:
            cells += ["–"] * 4
        rows.append(cells)
    head = ["Table 2.4", "time / s", "modelling MAE", "RMSE", "generalisation MAE", "RMSE", "max / µm", "third family"]
    head += ["published time / s", "published modelling", "published generalisation", "published max / µm"]
    runs = [run for run in study.forward if run.key not in ("lssvm_given",)]
    best = min(runs, key=lambda run: run.generalisation.mae_pct)
    fitted = min(runs, key=lambda run: run.training.rmse_pct)
    two, bouc_wen = study.model("lssvm"), study.model("bouc_wen")
    text = (
        f"Best on the training record: {fitted.label}; best on (2.45): {best.label}. The chapter's ranking (LSSVM "
        "before Bouc-Wen before MPI) "
    )
    if study.name == "bouc_wen":
        text += (
            "does not hold here and must not: this stage *is* a Bouc-Wen model, and that model gets down to the "
            f"noise ({bouc_wen.training.rmse_pct:.4f} % RMSE)."
        )
    else:
        text += (
            "is not reproduced here: Bouc-Wen and MPI do several times better than published, the two-input LSSVM "
            f"about as published ({two.training.mae_pct:.3f} and {two.generalisation.mae_pct:.3f} % MAE). What "
            "separates them is memory: (u, du/dt) does not determine y, and a kernel on the pair averages over the "
            "histories that led there. The chapter's stage was harder on Bouc-Wen and MPI than this one is: its "
            "errors depend on rate, and neither model has any rate in its hysteresis; the row with a lag shows what "
            "one time constant is worth. With play operators as further inputs the same solver is the best by far."
        )
    return "\n".join(
        [
            "## Modelling and generalisation: Table 2.4\n",
            table(head, rows),
            text + "\n",
            "All models are identified from the same 500 displacements at 0.02 s, and times are of identification "
            "alone, in seconds of one core. Models with memory run on the voltage commanded at 1 ms. The third "
            "family is minor loops, a plain 5 Hz sine and random multi-tones; its column is the mean MAE over them.\n",
        ]
    )


def _inverse(ours: dict[str, Any]) -> str:
    found = ours["table_2_4_inverse"]
    names = list(next(iter(found.values()))["scores"])
    labels = {**FROZEN, **{key: label for key, (label, _) in LEARNING.items()}}
    rows = [
        [labels[key], *(number(entry["scores"][name]["mae_pct"]) for name in names)] for key, entry in found.items()
    ]
    return "\n".join(
        [
            "## The same for inverse models, frozen and learning\n",
            table(["MAE, %", "(2.45)", *names[1:]], rows),
            "Each model is given the measured motion of a record, smoothed, and answers with a voltage; errors are "
            "voltages seen as displacement through the mean gain. Frozen ones know (2.37) at 1 ms and nothing else. "
            "Learning ones begin there at each record and learn along it, each voltage from a snapshot that is at "
            "least 40 ms old. That Bouc-Wen and MPI learn as well makes the comparison one between models, not "
            "between learning and not learning.\n",
        ]
    )


def _third(ours: dict[str, Any], pictures: dict[str, str]) -> str:
    models = ours["table_2_4"]
    names = list(next(iter(models.values()))["third_family"])
    rows = [
        [found["label"] + ", " + found["route"], *(number(found["third_family"][name]["mae_pct"]) for name in names)]
        for found in models.values()
    ]
    return "\n".join(
        [
            picture(pictures, "2.13", "Fig. 2.13"),
            picture(pictures, "2.14", "Fig. 2.14"),
            picture(pictures, "2.15", "Fig. 2.15"),
            "## What the chapter did not test\n",
            table(["MAE, %", *names], rows),
            "The decaying sweeps of the chapter hide what two inputs lack: their envelope only shrinks, so that each "
            "state is reached by one kind of history. A plain sine or minor loops show it at once.\n",
            picture(pictures, "third", "third family"),
        ]
    )
