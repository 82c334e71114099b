"""The exported C is the model: every kind, along any motion, with its limits, in double and in single precision."""

from __future__ import annotations

import functools
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.service.answers.answering import derivatives
from dehyst.service.answers.guard import Limits, limit_voltage
from dehyst.service.export.c_source import domain
from dehyst.service.export.exporting import Frozen, voltages, write_export
from dehyst.service.protocol.model import decode_model
from tests.service.export.compiled import STRICT, Run, compiled, needs_a_compiler

pytestmark = needs_a_compiler
VECTORS = Path(__file__).resolve().parents[3] / "docs" / "protocol" / "vectors"
#: The models of the protocol's vectors, all kinds and forms that a service serves; some stand there more than once.
AGAIN = {"linear-unknown-std", "lssvm-distrusted", "lssvm-compared", "overflowing-alone"}
MODELS = sorted({path.name.removesuffix(".model.payload") for path in VECTORS.glob("*.model.payload")} - AGAIN)
MODELS = [name for name in MODELS if not name.startswith("auto-")]
#: Some millivolts a sample: moves reach it.
LIMITS = Limits(0.5, 7.0, 60.0, -10.0, 110.0)


def model_of(name: str) -> InverseModel:
    return decode_model((VECTORS / f"{name}.model.payload").read_bytes()).model


def frozen_of(name: str, limits: Limits = LIMITS) -> Frozen:
    return Frozen(model_of(name), limits, "it", "a test")


@functools.cache
def in_c(name: str, *flags: str) -> tuple[Run, float, float]:
    run, source = compiled(frozen_of(name), *flags)
    return run, source.error_V, source.error_single_V


#: (end of a move as a share of the domain, its duration and the rest after it in samples; what becomes of one point)
moves = st.lists(
    st.tuples(
        st.floats(-0.1, 1.1), st.integers(1, 60), st.integers(0, 40), st.sampled_from([None] * 6 + [math.nan, 1e6])
    ),
    min_size=1, max_size=12,
)  # fmt: skip


def motion_of(frozen: Frozen, wanted: list[tuple[float, int, int, float | None]]) -> tuple[FloatArray, ...]:
    """Moves with turning points, inner loops and rests; single points that no service would take."""
    low, high = domain(frozen.model)[0]
    y, wrong = [np.full(3, 0.5 * (low + high))], {}
    for share, n, rest, bad in wanted:
        end = low + share * (high - low)
        y += [y[-1][-1] + (end - y[-1][-1]) * np.linspace(0.0, 1.0, n + 1)[1:], np.full(rest, end)]
        y = [np.concatenate(y)]
        if bad is not None:
            wrong[y[0].size - 1] = bad
    v, a = derivatives(y[0], None, None, frozen.model.dt_s)
    motion = np.array([y[0], v, a]).astype(np.float32).astype(np.float64)
    for at, bad in wrong.items():
        motion[at % 3, at] = bad if at % 3 == 0 else math.nan
    return tuple(motion)


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=25, deadline=None)
@given(wanted=moves)
def test_it_is_the_model_along_any_motion(name: str, wanted: list[tuple[float, int, int, float | None]]) -> None:
    frozen = frozen_of(name)
    motion = motion_of(frozen, wanted)
    expected, flags = voltages(frozen, *motion)
    run, _, error_single_V = in_c(name)
    u, found = run(*motion)
    np.testing.assert_allclose(u, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(found, flags)
    u, _ = in_c(name, "-DIT_SINGLE")[0](*motion)
    np.testing.assert_allclose(u, expected, rtol=0.0, atol=error_single_V)
    assert LIMITS.u_min_V <= u.min() <= u.max() <= LIMITS.u_max_V


@pytest.mark.parametrize("before", [math.nan, 0.0, 3.0, 12.0])
def test_the_limits_are_those_of_the_service(before: float, tmp_path: Path) -> None:
    """From any voltage before, also one outside of the limits, by `limit_voltage` itself."""
    model = model_of("linear")
    program = (
        '#include "it.h"\n#include <stdio.h>\n#include <stdlib.h>\nint main(int n, char **words)\n{\n'
        "    it_state axis;\n    it_init(&axis, 0.0);\n    axis.u_V = strtod(words[n - 1], NULL);\n"
        "    for (int i = 0; i < 150; i++) {\n        double u = it_step(&axis, 50.0, 0.0, 0.0);\n"
        '        printf("%.17g %d\\n", u, axis.flags);\n    }\n    return 0;\n}\n'
    )
    write_export(Frozen(model, LIMITS, "it", "a test"), tmp_path, None, 1.0, fmu=False)
    (tmp_path / "main.c").write_text(program)
    subprocess.run(["cc", *STRICT, "it.c", "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    said = subprocess.run([tmp_path / "main", str(before)], capture_output=True, text=True, check=True).stdout
    still = np.zeros(1)
    wanted = float(model.feedforward(np.array([50.0]), still, still, model.rest_memory(50.0)).u_V[0])
    for line in said.splitlines():
        u, flags = line.split()
        before, expected = limit_voltage(wanted, before, LIMITS.u_min_V, LIMITS.u_max_V, LIMITS.slew_V_per_s * 1e-3)
        assert float(u) == pytest.approx(before, abs=1e-12)
        assert int(flags) & 3 == expected & 3


@pytest.mark.parametrize("flags", [(), ("-DIT_SINGLE",)], ids=["double", "single"])
@pytest.mark.parametrize("name", ["lssvm", "mpi", "bouc_wen", "linear"])
def test_the_test_beside_it_passes_and_sees_a_wrong_table(name: str, flags: tuple[str, ...], tmp_path: Path) -> None:
    write_export(frozen_of(name), tmp_path, None, 1.0, fmu=False)
    cc = ["cc", *STRICT, "-O2", *flags, "it.c", "it_test.c", "-o", "check", "-lm"]
    subprocess.run(cc, cwd=tmp_path, check=True)
    done = subprocess.run(["./check", "it_vectors.csv"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "us a point" in done.stdout
    lines = (tmp_path / "it_vectors.csv").read_text().splitlines()
    row = lines[700].split(",")
    lines[700] = ",".join([*row[:3], repr(float(row[3]) + 1e-3), row[4]])
    (tmp_path / "it_vectors.csv").write_text("\n".join(lines))
    assert subprocess.run(["./check", "it_vectors.csv"], cwd=tmp_path, capture_output=True, check=False).returncode == 1


@pytest.mark.parametrize("origin", ["a */ int b = c; /*", "a\n#error b", "*/*/", "µm \\\\"])
def test_no_name_of_a_recording_breaks_out_of_the_comment(origin: str) -> None:
    run, _ = compiled(Frozen(model_of("linear"), LIMITS, "it", origin))
    assert np.isfinite(run(*np.zeros((3, 2)))[0]).all()


def test_it_refuses_to_be_compiled_with_fast_math() -> None:
    with pytest.raises(subprocess.CalledProcessError):
        compiled(frozen_of("linear"), "-ffast-math")


def test_a_name_that_is_none_in_c_is_refused() -> None:
    with pytest.raises(InputError, match="--name: got 'my stage'"):
        compiled(Frozen(model_of("linear"), LIMITS, "my stage", ""))


def test_a_kind_without_a_template_is_named() -> None:
    class Other:
        name = "mine"
        dt_s = 1e-3

    with pytest.raises(InputError, match="model 'mine': got a Other, expected a kind that can be exported"):
        compiled(Frozen(Other(), LIMITS, "it", ""))  # type: ignore[arg-type]
