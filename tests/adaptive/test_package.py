"""What the package offers: the example at its top runs, and every name is imported only when it is used."""

from __future__ import annotations

import doctest
import subprocess
import sys

import pytest

from dehyst import adaptive


def test_the_example_runs() -> None:
    result = doctest.testmod(adaptive)
    assert result.attempted >= 10
    assert result.failed == 0


def test_every_name_that_is_offered_is_there() -> None:
    assert adaptive.__all__ == sorted(adaptive.__all__)
    for name in adaptive.__all__:
        assert getattr(adaptive, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'Unknown'"):
        adaptive.Unknown  # noqa: B018


def test_light_names_load_neither_numba_nor_scipy() -> None:
    code = (
        "import sys; from dehyst.adaptive import InputError, Sample; "
        "assert not {'numba', 'scipy'} & sys.modules.keys(), 'a heavy library was imported'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
