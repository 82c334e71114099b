"""report.md of a diagnosis: verdict, errors, causes with their numbers, limits, and the next experiment."""

from __future__ import annotations

from dataclasses import dataclass

from dehyst.sim.diagnosis.export import ExportedStage
from dehyst.sim.diagnosis.result import TEST, Diagnosis, NamedCause
from dehyst.sim.effects import Kind

#: Units by the suffix of a number's name.
_UNITS = {
    "_um_per_s": " µm/s", "_um_per_V": " µm/V", "_per_s": " /s", "_V_per_s": " V/s", "_um": " µm", "_hz": " Hz",
    "_Hz": " Hz", "_V": " V", "_s": " s", "_ppm": " ppm", "_per_K": " /K", "_um_per_K": " µm/K",
    "_per_um": " /µm",
}  # fmt: skip


def length(value_um: float) -> str:
    """A length in nm or µm."""
    return f"{1e3 * value_um:.3g} nm" if abs(value_um) < 1.0 else f"{value_um:.3g} µm"


def with_unit(name: str, value: float) -> str:
    """A number of a cause with the unit from its name."""
    for end in sorted(_UNITS, key=len, reverse=True):
        if name.endswith(end):
            return f"{value:.4g}{_UNITS[end]}"
    return f"{value:.4g}"


def spaced(name: str) -> str:
    """A cause's name in a sentence."""
    return name.replace("_", " ")


#: A held-out error within this factor of the noise floor counts as being at the floor.
AT_THE_FLOOR = 1.5
#: Most numbers of one cause on the page; report.json has all.
MOST_NUMBERS = 6
#: Source of a noise floor that is only an upper bound.
DIFFERENCES = "differences"
#: Names of the nominal stages in a sentence.
_NOMINALS = {"bouc_wen": "the chapter's Bouc-Wen stage", "linear": "a linear stage of one mode"}


@dataclass(frozen=True)
class Source:
    """Names of the recordings and of the nominal stage. ``test`` is empty without a test recording."""

    data: str
    findings: tuple[str, ...] = ()
    test: str = ""
    nominal: str = "bouc_wen"


def picture_name(place: int, cause: NamedCause) -> str:
    """File name of a cause's picture."""
    return f"{place + 1}-{cause.name}.png"


def page(diagnosis: Diagnosis, exported: ExportedStage, source: Source) -> str:
    """The content of report.md."""
    d = diagnosis
    lines = [f"# {source.data}: what the simulation lacks", "", *_summary(d, source), ""]
    lines += [*_errors(d), ""]
    if d.causes:
        lines += [*_causes(d), ""]
    lines += ["![residual before and after](residual.png)", ""]
    for place, cause in enumerate(d.causes):
        lines += _section(place, cause, d.catalogue.kind(cause.name))
    if d.verdict in ("unexplained", "partly") or d.left:
        lines += _left(d)
    lines += _limits(d)
    lines += [
        "## Next",
        "",
        f"Record: {d.next_experiment}." if d.next_experiment else "Nothing is open that another drive would settle.",
        "",
        _file(d, exported),
        "",
    ]
    findings = (*source.findings, *d.notes, *(defect.words for defect in d.defects))
    if findings:
        lines += ["## The recording itself", "", *(f"- {text}" for text in findings), ""]
    return "\n".join(lines)


def _file(d: Diagnosis, exported: ExportedStage) -> str:
    missing = (
        f"the stage library has no equal of {', '.join(spaced(n) for n in exported.left_out)} in the form found here."
    )
    if {c.name for c in d.causes} <= set(exported.left_out) and d.causes:
        return f"`stage.toml` is the calibrated nominal stage only: {missing}"
    kind = f"extended stage in part ({missing[:-1]})" if exported.left_out else "extended stage"
    return (
        f"`stage.toml` is the {kind if d.causes else 'calibrated stage'}: `dehyst stage --file stage.toml` and "
        "`dehyst rehearse --plant stage.toml` run it. "
        f"Its free run is {length(exported.rms_um)} rms from the model fitted here (the recorder's latch and hold and "
        "the noise left out)."
    )


def _summary(d: Diagnosis, source: Source) -> list[str]:
    data = d.nominal.model.data
    nominal = _NOMINALS.get(source.nominal, f"the stage of `{source.nominal}`")
    verdict = {
        "adequate": f"{nominal[0].upper()}{nominal[1:]} explains this recording down to its noise.",
        "effects": f"Beside {nominal} there is **{_listed(d)}**.",
        "partly": f"Beside {nominal} there is **{_listed(d)}**, but that explains only a part.",
        "unexplained": "Something is in this recording that no cause of the catalogue explains.",
    }[d.verdict]
    if d.verdict == "adequate" and d.nominal_heldout_um > AT_THE_FLOOR * d.noise_floor_um:
        verdict = f"What {nominal} leaves of this recording has the spectrum of noise."
    if d.heldout_source == TEST and d.partial:
        lost = ", ".join(spaced(n) for n in d.partial)
        verdict = f"What was found in the recording ({lost}) does not carry over to the test recording. {verdict}"
    tested = f", tested on `{source.test}`" if source.test else ""
    return [
        f"**{d.verdict}.** {verdict} {_gain(d)}",
        "",
        f"`{source.data}`{tested}: {data.n} samples, {data.duration_s:.3g} s at {1.0 / data.dt_s:.5g} Hz, "
        f"{data.u_low_V:.3g} to {data.u_high_V:.3g} V, range {length(data.range_um)}.",
    ]


def _listed(d: Diagnosis) -> str:
    names = [spaced(c.name) + (f" (or {', '.join(spaced(a) for a in c.alternatives)})" * bool(c.alternatives))
             for c in d.causes]  # fmt: skip
    return f"{', '.join(names[:-1])} and {names[-1]}" if len(names) > 1 else "".join(names)


def _gain(d: Diagnosis) -> str:
    """How much the causes reduce the held-out error, in one sentence."""
    before, after, floor = d.nominal_heldout_um, d.extended_heldout_um, d.noise_floor_um
    where = "the test recording" if d.heldout_source == TEST else "data that was not used"
    if not d.causes:
        return f"Its error on {where} is {length(before)}; the noise floor is {length(floor)}."
    if after > 0.98 * before:
        return (
            f"But on {where} the error does not fall by that ({length(before)} before, {length(after)} after): these "
            "numbers hold for this recording and do not carry over."
        )
    return f"With it the error on {where} falls from {length(before)} to {length(after)}, {_beside_floor(after, d)}."


def _beside_floor(error_um: float, d: Diagnosis) -> str:
    """An error relative to the noise floor, in words."""
    floor = d.noise_floor_um
    near = error_um <= AT_THE_FLOOR * floor
    if near and d.floor_source == DIFFERENCES:
        # Without rests or periods the estimate contains fast motion.
        where = "below" if error_um <= floor else "near"
        return f"{where} the only bound on the noise that this recording gives ({length(floor)}, from differences)"
    if error_um < 0.5 * floor:
        return f"below its own noise floor ({length(floor)}): the test recording is quieter"
    rest = "at the noise floor" if near else f"{error_um / floor:.2g} times the noise floor"
    return f"{rest} ({length(floor)})"


def _errors(d: Diagnosis) -> list[str]:
    held = "on the test recording" if d.heldout_source == TEST else "held out, fold by fold"
    bound = ", at most" if d.floor_source == DIFFERENCES else ""
    return [
        f"| free-run error, rms | on this recording | {held} |",
        "|---|---|---|",
        f"| nominal stage, calibrated | {length(d.nominal_rmse_um)} | {length(d.nominal_heldout_um)} |",
        f"| extended stage | {length(d.extended_rmse_um)} | {length(d.extended_heldout_um)} |",
        f"| noise floor{bound}, from {d.floor_source} | {length(d.noise_floor_um)} | |",
        f"| black box, beside the nominal stage | | {length(d.ceiling_um)} |",
        *(
            []
            if d.taught_um is None
            else [f"| the best that was learnt from this recording | | {length(d.taught_um)} |"]
        ),
        "",
        *_explainable(d),
    ]


def _explainable(d: Diagnosis) -> list[str]:
    """The nominal error by what it is: noise, explained by named causes, by a black box only, by nothing."""
    nominal, extended = d.nominal_heldout_um**2, d.extended_heldout_um**2
    if nominal <= 0.0:
        return []
    floor = min(d.noise_floor_um**2, nominal)
    reached = min(max(extended, floor), nominal) if d.causes else nominal
    box = min(max(d.ceiling_um**2, floor), reached)
    parts = [floor, box - floor, reached - box, nominal - reached]
    noise, nothing, box_only, named = (100.0 * part / nominal for part in parts)
    return [
        "| of the nominal stage's squared error | noise floor | named causes | a black box, but no cause | nothing |",
        "|---|---|---|---|---|",
        f"| {length(d.nominal_heldout_um)} rms | {noise:.3g} % | {named:.3g} % | {box_only:.3g} % | {nothing:.3g} % |",
    ]


def _causes(d: Diagnosis) -> list[str]:
    lines = [
        "| cause | or | number | 95 % interval | removes | by chance | direct test |",
        "|---|---|---|---|---|---|---|",
    ]
    for c in d.causes:
        first = best_known_number(c)
        number = f"{first} = {with_unit(first, c.parameters[first])}" if first else ""
        low, high = c.intervals.get(first, (float("nan"), float("nan")))
        lines.append(
            f"| **{spaced(c.name)}** | {', '.join(spaced(a) for a in c.alternatives) or '-'} | {number} | {low:.4g} to "
            f"{high:.4g} | {100.0 * c.heldout_gain:.3g} % | {100.0 * c.p_value:.2g} % | {_sight(c)} |"
        )
    lines += [
        "",
        "*Removes*: share of the held-out squared error left by those above it. *By chance*: how often noise alone "
        "gains as much. *Direct test*: whether its signature is seen in the readings without any fit.",
    ]
    return lines


def best_known_number(cause: NamedCause) -> str:
    """The name of the number with the smallest relative interval, for the table."""

    def certainty(name: str) -> float:
        low, high = cause.intervals[name]
        # An interval of width zero is a number at its bound, which is not known at all.
        return abs(cause.parameters[name]) / (high - low) if high > low else 0.0

    return max(cause.parameters, key=certainty, default="")


def _sight(cause: NamedCause) -> str:
    """The direct test of a cause in a word."""
    if cause.witness is None:
        return "none exists"
    return {True: "seen", False: "not seen", None: "not excited"}[cause.witness.seen]


def _section(place: int, cause: NamedCause, kind: Kind) -> list[str]:
    lines = [f"## {place + 1}. {spaced(cause.name)}", "", f"![{cause.name}]({picture_name(place, cause)})", ""]
    numbers = []
    for name, value in list(cause.parameters.items())[:MOST_NUMBERS]:
        low, high = cause.intervals[name]
        numbers.append(f"{name} = {with_unit(name, value)} ({low:.4g} to {high:.4g})")
    more = len(cause.parameters) - len(numbers)
    lines.append(f"{'; '.join(numbers)}{f'; and {more} more in report.json' if more > 0 else ''}.")
    if cause.intervals and all(low <= 0.0 <= high for low, high in cause.intervals.values()):
        lines.append(
            "**The intervals of all its numbers hold zero**: the error falls with it on data that was not fitted, but "
            "how large it is, this recording does not say."
        )
    if cause.witness is not None:
        told = {
            True: f"Seen in the readings without a fit: {cause.witness.words}.",
            False: f"**A direct test of the readings does not show it**: {cause.witness.words}.",
            None: f"This recording does not excite a direct test of it: {cause.witness.words}. Only the fit names it.",
        }
        lines.append(told[cause.witness.seen])
    lines.append(f"Its signature: {kind.signature}.")
    if kind.mistaken_for:
        others = ", ".join(spaced(n) for n in kind.mistaken_for)
        lines.append(f"Easily mistaken for {others}; {kind.tells_apart}.")
    if cause.alternatives:
        others = ", ".join(spaced(a) for a in cause.alternatives)
        instead = [f"{spaced(a)} removes {min(100.0 * s, 100.0):.0f} %" for a, s in cause.instead.items()]
        because = f": of what it removes, {', '.join(instead)} in its place" if instead else ""
        lines.append(f"**This recording cannot tell it from {others}**{because}.")
    return [*lines, ""]


def _left(d: Diagnosis) -> list[str]:
    lines = ["## What is left", ""]
    if d.left:
        lines += [f"- {text}" for text in d.left]
    if d.ceiling_um < 0.9 * d.extended_heldout_um:
        lines.append(
            f"- a black box brings the error to {length(d.ceiling_um)}: a part repeats with the drive, and no cause of "
            "the catalogue has its form"
        )
    elif d.left:
        lines.append("- a black box does not predict it better: it does not repeat with the drive in a known form")
    if d.taught_um is not None and d.taught_um > 1.2 * d.ceiling_um:
        lines.append(
            f"- the best model that was fitted to the recording, a black box included, leaves {length(d.taught_um)} on "
            f"the test recording: what lies between that and {length(d.ceiling_um)} cannot be learnt from this "
            "recording; record more motions"
        )
    if d.partial:
        names = ", ".join(spaced(n) for n in d.partial)
        lines += ["", f"Tried and not named, because together they explain too little here: {names}."]
    return [*lines, ""]


def _limits(d: Diagnosis) -> list[str]:
    lines = ["## What this recording cannot say", ""]
    lines.append(
        f"Not excited, their usual size would not show here: {', '.join(spaced(n) for n in d.not_excited)}."
        if d.not_excited
        else "Every cause of the catalogue would have shown."
    )
    sets = [f"{spaced(c.name)} and {', '.join(spaced(a) for a in c.alternatives)}" for c in d.causes if c.alternatives]
    if sets:
        lines.append(f"Inseparable here: {'; '.join(sets)}.")
    if d.causes and d.extended_heldout_um > AT_THE_FLOOR * d.noise_floor_um:
        lines.append(
            f"What is left after the extension is {d.extended_heldout_um / d.noise_floor_um:.2g} times the noise "
            "floor: the forms are approximations, or something small is still unnamed."
        )
    return [*lines, ""]
