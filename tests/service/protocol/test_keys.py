"""Names and keys."""

from __future__ import annotations

import pytest
import zenoh

from adaptive.errors import InputError
from service.protocol.keys import Keys, check_name


def test_keys_are_those_of_the_page() -> None:
    keys = Keys("demo", "x")
    assert keys.sample == "dehyst/v1/demo/x/sample"
    assert keys.alive("i1") == "dehyst/v1/demo/x/alive/i1"
    names = ("sample", "command", "reference", "feedforward", "model", "status", "event", "diagnostics")
    assert [getattr(keys, name) for name in names] == [f"dehyst/v1/demo/x/{name}" for name in names]
    assert zenoh.KeyExpr(keys.alive_any).includes(zenoh.KeyExpr(keys.alive("i1")))


@pytest.mark.parametrize("name", ["", "X", "a/b", "*", "**", "a$*", "1a", "a b", "ä", "a" * 65, "a\n", None, 3])
def test_names_that_cannot_be_part_of_a_key_are_refused(name: object) -> None:
    with pytest.raises(InputError, match="stage"):
        check_name("stage", name)


@pytest.mark.parametrize("name", ["a", "x_linear", "stage-2", "a" * 64])
def test_good_names_are_chunks_of_zenoh_too(name: str) -> None:
    assert str(zenoh.KeyExpr(Keys(name, name).feedforward)) == f"dehyst/v1/{name}/{name}/feedforward"
