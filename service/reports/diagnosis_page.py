"""report.md of a diagnosis: verdict, errors, causes with their numbers, limits, and the next experiment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from dehyst.service.reports.tables import markdown
from dehyst.sim.diagnosis.export import ExportedStage
from dehyst.sim.diagnosis.result import TEST, Diagnosis, NamedCause
from dehyst.sim.effects import Kind

#: Units by the suffix of a number's name; the longest that fits counts.
_UNITS = {
    "_um_per_s": " µm/s", "_um_per_V": " µm/V", "_um_per_K": " µm/K", "_V_per_s": " V/s", "_per_um": " /µm",
    "_per_s": " /s", "_per_K": " /K", "_ppm": " ppm", "_um": " µm", "_hz": " Hz", "_Hz": " Hz", "_V": " V", "_s": " s",
}  # fmt: skip
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


def length(value_um: float) -> str:
    """A length in nm or µm."""
    return f"{1e3 * value_um:.3g} nm" if abs(value_um) < 1.0 else f"{value_um:.3g} µm"


def with_unit(name: str, value: float) -> str:
    """A number of a cause with the unit from its name."""
    return f"{value:.4g}{next((unit for end, unit in _UNITS.items() if name.endswith(end)), '')}"


def spaced(*names: str) -> str:
    """Names of causes in a sentence."""
    return ", ".join(names).replace("_", " ")


def picture_name(place: int, cause: NamedCause) -> str:
    """File name of a cause's picture."""
    return f"{place + 1}-{cause.name}.png"


def page(diagnosis: Diagnosis, exported: ExportedStage, source: Source) -> str:
    """The content of report.md."""
    d = diagnosis
    findings = (*source.findings, *d.notes, *(defect.words for defect in d.defects))
    not_excited = f"Not excited, their usual size would not show here: {spaced(*d.not_excited)}."
    parts = [
        f"# {source.data}: what the simulation lacks",
        *_summary(d, source),
        *_errors(d),
        _causes(d) if d.causes else "",
        "![residual before and after](residual.png)",
        *(_section(place, cause, d.catalogue.kind(cause.name)) for place, cause in enumerate(d.causes)),
        *(_left(d) if d.verdict in ("unexplained", "partly") or d.left else ()),
        "## What this recording cannot say",
        not_excited if d.not_excited else "Every cause of the catalogue would have shown.",
        "## Next",
        f"Record: {d.next_experiment}." if d.next_experiment else "Nothing is open that another drive would settle.",
        _file(d, exported),
        "## The recording itself" if findings else "",
        "\n".join(f"- {text}" for text in findings),
    ]
    return "\n\n".join(filter(None, parts)) + "\n"


def _file(d: Diagnosis, exported: ExportedStage) -> str:
    missing = f"the stage library has no equal of {spaced(*exported.left_out)} in the form found here"
    if d.causes and {c.name for c in d.causes} <= set(exported.left_out):
        return f"`stage.toml` is the calibrated nominal stage only: {missing}."
    kind = f"extended stage in part ({missing})" if exported.left_out else "extended stage"
    return (
        f"`stage.toml` is the {kind if d.causes else 'calibrated stage'}: `dehyst stage --file stage.toml` and "
        "`dehyst rehearse --plant stage.toml` run it. "
        f"Its free run is {length(exported.rms_um)} rms from the model fitted here (the recorder's latch and hold and "
        "the noise left out)."
    )


def _summary(d: Diagnosis, source: Source) -> Iterable[str]:
    data = d.nominal.model.data
    nominal = _NOMINALS.get(source.nominal, f"the stage of `{source.nominal}`")
    names = [spaced(c.name) + (f" (or {spaced(*c.alternatives)})" if c.alternatives else "") for c in d.causes]
    listed = " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))
    verdict = {
        "adequate": f"{nominal[0].upper()}{nominal[1:]} explains this recording down to its noise.",
        "effects": f"Beside {nominal} there is **{listed}**.",
        "partly": f"Beside {nominal} there is **{listed}**, but that explains only a part.",
        "unexplained": "Something is in this recording that no cause of the catalogue explains.",
    }[d.verdict]
    if d.verdict == "adequate" and d.nominal_heldout_um > AT_THE_FLOOR * d.noise_floor_um:
        verdict = f"What {nominal} leaves of this recording has the spectrum of noise."
    if d.heldout_source == TEST and d.partial:
        verdict = (
            f"What was found in the recording ({spaced(*d.partial)}) does not carry over to the test recording. "
            f"{verdict}"
        )
    yield f"**{d.verdict}.** {verdict} {_gain(d)}"
    tested = f", tested on `{source.test}`" if source.test else ""
    yield (
        f"`{source.data}`{tested}: {data.n} samples, {data.duration_s:.3g} s at {1.0 / data.dt_s:.5g} Hz, "
        f"{data.u_low_V:.3g} to {data.u_high_V:.3g} V, range {length(data.range_um)}."
    )


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
    if after <= AT_THE_FLOOR * floor and d.floor_source == DIFFERENCES:
        # Without rests or periods the estimate contains fast motion.
        beside = f"{'below' if after <= floor else 'near'} the only bound on the noise that this recording gives"
        floored = f"{length(floor)}, from differences"
    elif after < 0.5 * floor:
        beside, floored = "below its own noise floor: the test recording is quieter", length(floor)
    else:
        at_floor = after <= AT_THE_FLOOR * floor
        beside = "at the noise floor" if at_floor else f"{after / floor:.2g} times the noise floor"
        floored = length(floor)
    return f"With it the error on {where} falls from {length(before)} to {length(after)}, {beside} ({floored})."


def _errors(d: Diagnosis) -> Iterable[str]:
    """The table of errors, and the nominal error by what it is: noise, named causes, a black box only, nothing."""
    bound = ", at most" if d.floor_source == DIFFERENCES else ""
    rows = [
        ("nominal stage, calibrated", length(d.nominal_rmse_um), length(d.nominal_heldout_um)),
        ("extended stage", length(d.extended_rmse_um), length(d.extended_heldout_um)),
        (f"noise floor{bound}, from {d.floor_source}", length(d.noise_floor_um), ""),
        ("black box, beside the nominal stage", "", length(d.ceiling_um)),
    ]
    if d.taught_um is not None:
        rows.append(("the best that was learnt from this recording", "", length(d.taught_um)))
    held = "on the test recording" if d.heldout_source == TEST else "held out, fold by fold"
    yield markdown(("free-run error, rms", "on this recording", held), rows)
    nominal, extended = d.nominal_heldout_um**2, d.extended_heldout_um**2
    if nominal <= 0.0:
        return
    floor = min(d.noise_floor_um**2, nominal)
    reached = min(max(extended, floor), nominal) if d.causes else nominal
    box = min(max(d.ceiling_um**2, floor), reached)
    shares = [f"{100.0 * part / nominal:.3g} %" for part in (floor, nominal - reached, reached - box, box - floor)]
    head = (
        "of the nominal stage's squared error",
        "noise floor",
        "named causes",
        "a black box, but no cause",
        "nothing",
    )
    yield markdown(head, [(f"{length(d.nominal_heldout_um)} rms", *shares)])


def _causes(d: Diagnosis) -> str:
    rows = []
    for c in d.causes:
        first = best_known_number(c)
        number = f"{first} = {with_unit(first, c.parameters[first])}" if first else ""
        low, high = c.intervals.get(first, (float("nan"), float("nan")))
        sight = "none exists"
        if c.witness is not None:
            sight = {True: "seen", False: "not seen", None: "not excited"}[c.witness.seen]
        rows.append((
            f"**{spaced(c.name)}**", spaced(*c.alternatives) or "-", number, f"{low:.4g} to {high:.4g}",
            f"{100.0 * c.heldout_gain:.3g} %", f"{100.0 * c.p_value:.2g} %", sight,
        ))  # fmt: skip
    head = ("cause", "or", "number", "95 % interval", "removes", "by chance", "direct test")
    return markdown(head, rows) + (
        "\n\n*Removes*: share of the held-out squared error left by those above it. *By chance*: how often noise alone "
        "gains as much. *Direct test*: whether its signature is seen in the readings without any fit."
    )


def best_known_number(cause: NamedCause) -> str:
    """The name of the number with the smallest relative interval, for the table."""

    def certainty(name: str) -> float:
        low, high = cause.intervals[name]
        # An interval of width zero is a number at its bound, which is not known at all.
        return abs(cause.parameters[name]) / (high - low) if high > low else 0.0

    return max(cause.parameters, key=certainty, default="")


def _section(place: int, cause: NamedCause, kind: Kind) -> str:
    shown = [
        "{} = {} ({:.4g} to {:.4g})".format(name, with_unit(name, value), *cause.intervals[name])
        for name, value in list(cause.parameters.items())[:MOST_NUMBERS]
    ]
    more = len(cause.parameters) - len(shown)
    lines = ["; ".join(shown) + (f"; and {more} more in report.json" if more > 0 else "") + "."]
    if cause.intervals and all(low <= 0.0 <= high for low, high in cause.intervals.values()):
        lines.append(
            "**The intervals of all its numbers hold zero**: the error falls with it on data that was not fitted, but "
            "how large it is, this recording does not say."
        )
    if cause.witness is not None:
        told = {
            True: "Seen in the readings without a fit: {}.",
            False: "**A direct test of the readings does not show it**: {}.",
            None: "This recording does not excite a direct test of it: {}. Only the fit names it.",
        }
        lines.append(told[cause.witness.seen].format(cause.witness.words))
    lines.append(f"Its signature: {kind.signature}.")
    if kind.mistaken_for:
        lines.append(f"Easily mistaken for {spaced(*kind.mistaken_for)}; {kind.tells_apart}.")
    if cause.alternatives:
        instead = [f"{spaced(a)} removes {min(100.0 * s, 100.0):.0f} %" for a, s in cause.instead.items()]
        because = f": of what it removes, {', '.join(instead)} in its place" if instead else ""
        lines.append(f"**This recording cannot tell it from {spaced(*cause.alternatives)}**{because}.")
    picture = f"![{cause.name}]({picture_name(place, cause)})"
    return f"## {place + 1}. {spaced(cause.name)}\n\n{picture}\n\n" + "\n".join(lines)


def _left(d: Diagnosis) -> Iterable[str]:
    yield "## What is left"
    lines = list(d.left)
    if d.ceiling_um < 0.9 * d.extended_heldout_um:
        lines.append(
            f"a black box brings the error to {length(d.ceiling_um)}: a part repeats with the drive, and no cause of "
            "the catalogue has its form"
        )
    elif d.left:
        lines.append("a black box does not predict it better: it does not repeat with the drive in a known form")
    if d.taught_um is not None and d.taught_um > 1.2 * d.ceiling_um:
        lines.append(
            f"the best model that was fitted to the recording, a black box included, leaves {length(d.taught_um)} on "
            f"the test recording: what lies between that and {length(d.ceiling_um)} cannot be learnt from this "
            "recording; record more motions"
        )
    yield "\n".join(f"- {line}" for line in lines)
    if d.partial:
        yield f"Tried and not named, because together they explain too little here: {spaced(*d.partial)}."
