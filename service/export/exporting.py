"""The files of an export: C with its test, the tables of a periodic motion, and an FMU."""

from __future__ import annotations

import math
import os
import platform
import shutil
import subprocess
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import derivatives
from dehyst.service.answers.guard import Limits, guard
from dehyst.service.export.c_source import CSource, c_source, domain
from dehyst.service.protocol.errors import FieldError
from dehyst.service.storage.output import atomic_write

#: Periods that a table's motion runs before the one that is written: the memory of an unlimited creep has settled then.
_PERIODS: Final = 5
_PLACES: Final = 257
#: Share of the learnt range that a table leaves out at each end by default.
_WITHIN: Final = 0.05
_VECTORS: Final = 2000


@dataclass(frozen=True, slots=True)
class Frozen:
    """A model that learns no further, with what it needs outside the service.

    Attributes
    ----------
    model : of a champion among contestants, the champion's own. limits : of voltages. name : of files and functions.
    origin : one line, for people.
    """

    model: InverseModel
    limits: Limits
    name: str
    origin: str

    def __post_init__(self) -> None:
        if isinstance(self.model, ChampionInverse):
            object.__setattr__(self, "model", self.model.served)
        # It stands in a comment of C: names of recordings come from anybody.
        line = " ".join(self.origin.split()).replace("/*", "/ *").replace("*/", "* /")
        object.__setattr__(self, "origin", line)


def voltages(
    frozen: Frozen, y_um: FloatArray, v_um_per_s: FloatArray, a_um_per_s2: FloatArray
) -> tuple[FloatArray, NDArray[np.uint8]]:
    """(voltages V, flags), (n,) each, for (n,) points from rest at the first: what the exported C has to say.

    As the service, it takes no point that is not finite or that is beyond the displacement limits.
    """
    model, limits = frozen.model, frozen.limits
    taken = np.isfinite(y_um + v_um_per_s + a_um_per_s2) & (y_um >= limits.y_min_um) & (y_um <= limits.y_max_um)
    u_V, inside = np.full(y_um.size, math.nan), np.zeros(y_um.size, dtype=np.bool_)
    with np.errstate(all="ignore"):  # voltages out of this world are replaced
        points = y_um[taken], v_um_per_s[taken], a_um_per_s2[taken]
        got = model.feedforward(*points, model.rest_memory(float(y_um[0])))
    u_V[taken], inside[taken] = got.u_V, got.inside
    return guard(u_V, inside, model.dt_s, limits)


def trial_motion(frozen: Frozen) -> tuple[FloatArray, FloatArray, FloatArray]:
    """y µm, v µm/s, a µm/s², (n,) each: moves to random places and rests, one point of NaN, a little beyond the domain.

    All numbers are those of single precision, so that C of either precision gets the same.
    """
    (low, high), dt_s = domain(frozen.model)[0], frozen.model.dt_s
    rng = np.random.default_rng(1)
    places = [np.full(20, 0.5 * (low + high))]
    while sum(map(len, places)) < _VECTORS:
        begin, end = places[-1][-1], rng.uniform(low - 0.02 * (high - low), high + 0.02 * (high - low))
        n = int(rng.integers(30, 200))
        places += [begin + (end - begin) * 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, n))), np.full(n // 4, end)]
    y = np.concatenate(places)[:_VECTORS]
    v, a = derivatives(y, None, None, dt_s)
    y[_VECTORS // 2] = math.nan
    y, v, a = (column.astype(np.float32).astype(np.float64) for column in (y, v, a))
    return y, v, a


@dataclass(frozen=True, slots=True)
class Periodic:
    """The last of some periods of a sine, and the tables of its two branches.

    Attributes
    ----------
    y_um, u_V : (n,) motion and voltages, one sample time apart. places_um, rising_V, falling_V : (257,) the voltage at
    a place where the motion rises, and where it falls.
    """

    y_um: FloatArray
    u_V: FloatArray
    places_um: FloatArray
    rising_V: FloatArray
    falling_V: FloatArray

    @staticmethod
    def of(frozen: Frozen, low_um: float, high_um: float, hz: float) -> Periodic:
        """A sine between two places, ``hz`` periods a second."""
        n = round(1.0 / (hz * frozen.model.dt_s))
        phase = 2.0 * math.pi / n * np.arange(n * _PERIODS)
        half, omega = 0.5 * (high_um - low_um), 2.0 * math.pi / (n * frozen.model.dt_s)
        y = 0.5 * (low_um + high_um) - half * np.cos(phase)
        u_V, _ = voltages(frozen, y, half * omega * np.sin(phase), half * omega**2 * np.cos(phase))
        y, u_V, places = y[-n:], u_V[-n:], np.linspace(low_um, high_um, _PLACES)
        up, down = np.arange(n) <= n // 2, np.arange(n) >= n // 2
        # The falling branch ends where the next period begins.
        falling = np.interp(places, np.append(y[down], y[0])[::-1], np.append(u_V[down], u_V[0])[::-1])
        return Periodic(y, u_V, places, np.interp(places, y[up], u_V[up]), falling)

    def error_V(self, other: Periodic) -> float:
        """Largest error of the tables, V, on the motion of ``other``."""
        up = np.arange(other.y_um.size) <= other.y_um.size // 2
        tables = [np.interp(other.y_um, self.places_um, branch) for branch in (self.rising_V, self.falling_V)]
        return float(np.abs(np.where(up, *tables) - other.u_V).max())


def compiler() -> str:
    """The C compiler of this machine: CC, cc or gcc. Raises FieldError where there is none, or no FMU can be made."""
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        raise FieldError("--fmu", f"{platform.system()} {platform.machine()}", "Linux on x86_64", "export there")
    asked = os.environ.get("CC", "")
    found = next((path for name in ([asked] if asked else ["cc", "gcc"]) if (path := shutil.which(name))), None)
    if found is None:
        raise FieldError("--fmu", f"no C compiler ({asked or 'cc, gcc'})", "one", "install gcc, or name one by CC")
    return found


def _fmu(path: Path, name: str, source: CSource) -> None:
    """Compile and pack an FMU 2.0 for co-simulation. Raises FieldError with what the compiler says."""
    with tempfile.TemporaryDirectory() as place:
        folder, library = Path(place), Path(place) / f"{name}.so"
        for ending in (".h", ".c", "_fmu.c"):
            (folder / f"{name}{ending}").write_text(source.texts[ending], encoding="utf-8")
        command = [compiler(), "-std=c99", "-O3", "-fPIC", "-shared", "-fvisibility=hidden", "-o", library.name]
        done = subprocess.run(
            [*command, f"{name}.c", f"{name}_fmu.c", "-lm"], cwd=folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise FieldError("--fmu", f"{command[0]}: {done.stderr.strip()[:300]}", "C that compiles", "set CC")
        with atomic_write(path) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", source.texts[".xml"])
            archive.write(library, f"binaries/linux64/{library.name}")


def write_export(frozen: Frozen, out: Path, motion: tuple[float, float] | None, hz: float, fmu: bool) -> list[str]:
    """Write all files of ``frozen`` into the folder ``out``. Returns lines that say what they are and how exact.

    motion, hz : ends of the periodic motion of the tables, µm (the learnt range), and its periods a second.
    fmu : compile an FMU too.

    Raises InputError where the model, its name or the motion is unsuited, FieldError where an FMU cannot be made.
    """
    ends = domain(frozen.model)[0]
    low_um, high_um = motion or (ends + _WITHIN * np.array([1.0, -1.0]) * np.ptp(ends)).round(3).tolist()
    if not (low_um < high_um and 0.0 < hz <= 0.01 / frozen.model.dt_s):
        expected = f"LOW below HIGH, and up to {0.01 / frozen.model.dt_s:g} Hz: 100 samples in a period"
        raise FieldError("--motion, --hz", f"{low_um:g}:{high_um:g} µm, {hz:g} Hz", expected)
    source = c_source(frozen.model, frozen.limits, frozen.name, frozen.origin, low_um)
    y, v, a = trial_motion(frozen)
    u_V, flags = voltages(frozen, y, v, a)
    whole = Periodic.of(frozen, low_um, high_um, hz)
    quarter = 0.25 * (high_um - low_um)
    errors = [whole.error_V(Periodic.of(frozen, low_um + cut, high_um - cut, hz)) for cut in (0.0, quarter)]
    told = (
        f"largest error {1e3 * errors[0]:.3g} mV on {low_um:g} to {high_um:g} µm at {hz:g} Hz, "
        f"{1e3 * errors[1]:.3g} mV on half of it"
    )
    name, texts = frozen.name, {end: text for end, text in source.texts.items() if end in (".h", ".c", "_test.c")}
    texts["_vectors.csv"] = _csv(frozen.origin, "y_um,v_um_per_s,a_um_per_s2,u_V,flags", y, v, a, u_V, flags)
    texts["_table.csv"] = _csv(told, "y_um,rising_V,falling_V", whole.places_um, whole.rising_V, whole.falling_V)
    texts["_wave.txt"] = "".join(f"{u:.6f}\n" for u in whole.u_V.tolist())
    for ending, text in texts.items():
        with atomic_write(out / f"{name}{ending}") as file:
            file.write(text.encode())
    lines = [
        f"{name}.h, {name}.c: C99; error at most {source.error_V:.1e} V, in single precision "
        f"{source.error_single_V:.1e} V",
        f"{name}_test.c, {name}_vectors.csv: cc -O3 -march=native {name}.c {name}_test.c -lm && "
        f"./a.out {name}_vectors.csv",
        f"{name}_table.csv: voltage by place and direction; {told}",
        f"{name}_wave.txt: {whole.u_V.size} voltages of one period of it, {frozen.model.dt_s:g} s apart",
    ]
    if fmu:
        _fmu(out / f"{name}.fmu", name, source)
        lines.append(f"{name}.fmu: FMU 2.0 for co-simulation, linux64, step {frozen.model.dt_s:g} s")
    return lines


def _csv(comment: str, header: str, *columns: NDArray[np.generic]) -> str:
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return f"# {comment}\n{header}\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows)
