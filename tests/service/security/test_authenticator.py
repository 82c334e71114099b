"""The authenticator by itself: who can make one, what it is bound to, and how its key is found, made and read."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.service.config.settings import ServeConfig
from dehyst.service.security.authenticator import (
    NO_KEY,
    STAMP,
    TAG,
    Authenticator,
    Heard,
    HeardSamples,
    default_key,
    own_authenticator,
    read_key,
)
from dehyst.service.server.process import authenticator_of

KEY = b"0123456789abcdef"
OURS, THEIRS = Authenticator(KEY), Authenticator(b"a stranger's own one")


class Bytes(bytes):
    """Bytes as zenoh gives them."""

    def to_bytes(self) -> bytes:  # type: ignore[override]
        return bytes(self)


def said(payload: bytes, attached: bytes | None, key: str = "k", parameters: str = "") -> Any:
    """A publication, a reply or a query."""
    attachment = None if attached is None else Bytes(attached)
    return SimpleNamespace(payload=Bytes(payload), attachment=attachment, key_expr=key, parameters=parameters)


def test_only_who_has_the_key_can_sign() -> None:
    tag = OURS.tag("claim", "k", b"3")
    assert len(tag) == TAG
    assert OURS.proves(tag, "claim", "k", b"3")
    for parts in (("claim", "k", b"4"), ("claim", "l", b"3"), ("claimk", b"3"), ("claim", "k3"), ()):
        assert not OURS.proves(tag, *parts)
    assert not OURS.proves(THEIRS.tag("claim", "k", b"3"), "claim", "k", b"3")
    assert not OURS.proves(b"", "claim", "k", b"3")
    assert NO_KEY.proves(b"", "anything")
    assert OURS
    assert not NO_KEY


def test_a_reply_is_bound_to_key_parameters_stamp_and_payload_of_its_query() -> None:
    question = OURS.question("name=x", b"ask")
    asked = said(b"ask", question.attachment, parameters="name=x")
    right = OURS.answered(asked, "k", b"reply")
    assert right is not None
    signed = question.answer(said(b"reply", right))
    assert signed is not None
    assert (signed.payload, signed.stamp) == (b"reply", right[:STAMP])
    other = OURS.question("name=x", b"ask")
    for wrong in (
        said(b"other", right),
        said(b"reply", right, key="l"),
        said(b"reply", None),
        said(b"reply", b""),
        said(b"reply", right[:-1]),
        said(b"reply", bytes(STAMP) + right[STAMP:]),
        said(b"reply", OURS.answered(said(b"asked", question.attachment, parameters="name=x"), "k", b"reply")),
        said(b"reply", OURS.answered(said(b"ask", question.attachment, parameters="name=y"), "k", b"reply")),
        said(b"reply", OURS.answered(said(b"ask", other.attachment, parameters="name=x"), "k", b"reply")),
        said(b"reply", THEIRS.answered(asked, "k", b"reply")),
        said(b"reply", OURS.published("k", b"reply")),
    ):
        assert question.answer(wrong) is None
    assert OURS.answered(said(b"ask", None), "k", b"reply") is None
    assert NO_KEY.answered(asked, "k", b"reply") is None
    assert NO_KEY.question().answer(said(b"reply", None)) == (b"reply", b"")


def test_a_signed_query_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = said(b"ask", OURS.question("p=1", b"ask", key="k").attachment, parameters="p=1")
    assert not OURS.is_asked_by_ours(asked, "l")
    assert [OURS.is_asked_by_ours(asked, "k") for _ in range(2)] == [True, False]
    for wrong in (
        said(b"ask", OURS.question("p=1", b"ask").attachment, parameters="p=1"),
        said(b"ask", THEIRS.question("p=1", b"ask", key="k").attachment, parameters="p=1"),
        said(b"ask", OURS.question("p=1", b"ask", key="k").attachment, parameters="p=2"),
        said(b"no", OURS.question("p=1", b"ask", key="k").attachment, parameters="p=1"),
        said(b"ask", None, parameters="p=1"),
    ):
        assert not OURS.is_asked_by_ours(wrong, "k")
    monkeypatch.setattr("dehyst.service.security.authenticator._REMEMBERED", 2)
    for _ in range(3):  # many queries on another key: that one is still refused
        other = OURS.question("p=1", b"ask", key="l").attachment
        assert OURS.is_asked_by_ours(said(b"ask", other, parameters="p=1"), "l")
    assert not OURS.is_asked_by_ours(asked, "k")
    assert NO_KEY.is_asked_by_ours(said(b"ask", None), "k")


def test_a_publication_counts_once_in_order_and_of_the_sender_that_was_met() -> None:
    service, successor = Authenticator(KEY), Authenticator(KEY)
    heard = Heard(OURS, "k")
    first = service.published("k", b"1")
    assert heard.take(said(b"1", first)) is None
    assert heard.is_unknown
    heard.meet(service.stamp())
    assert heard.take(said(b"1", first)) is None  # it is in the reply by which it was met
    assert not heard.is_unknown
    second, third = service.published("k", b"2"), service.published("k", b"3")
    assert third is not None
    assert heard.take(said(b"3", third)) == b"3"
    assert heard.take(said(b"2", second)) is None
    assert heard.take(said(b"3", third)) is None
    assert heard.refused == 0
    assert heard.take(said(b"4", successor.published("k", b"4"))) is None
    assert heard.is_unknown
    heard.meet(successor.stamp())
    assert heard.take(said(b"5", successor.published("k", b"5"))) == b"5"
    assert heard.take(said(b"6", service.published("k", b"6"))) is None  # the one before
    for wrong in (
        said(b"5", None),
        said(b"5", bytes(32)),
        said(b"x", third),
        said(b"3", THEIRS.published("k", b"3")),
        said(b"3", successor.published("l", b"3")),
    ):
        assert heard.take(wrong) is None
    assert heard.refused == 5
    assert Heard(NO_KEY, "k").take(said(b"5", None)) == b"5"


def test_a_stage_that_signs_is_heard_alone_from_then_on() -> None:
    stage, heard = Authenticator(KEY), HeardSamples(OURS, "k")
    assert heard.take(said(b"1", None)) == b"1"
    attached = stage.published("k", b"2")
    assert [heard.take(said(b"2", attached)) for _ in range(2)] == [b"2", None]
    assert heard.take(said(b"3", None)) is None
    assert heard.take(said(b"3", THEIRS.published("k", b"3"))) is None
    assert heard.refused == 3
    for _ in range(100):  # its program was started anew, again and again
        assert heard.take(said(b"5", Authenticator(KEY).published("k", b"5"))) == b"5"
    assert heard.take(said(b"2", attached)) is None
    assert HeardSamples(NO_KEY, "k").take(said(b"3", attached)) == b"3"


def test_the_key_is_made_once_and_read_strictly(tmp_path: Path) -> None:
    path = tmp_path / "state" / "key"
    made = read_key(path, make=True)
    assert made
    assert made.path == path
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o077 == 0
    assert read_key(path, make=True).tag("a") == read_key(path).tag("a") == made.tag("a")
    assert [found.name for found in path.parent.iterdir()] == ["key"]
    with pytest.raises(InputError, match=r"key: got .*No such file"):
        read_key(tmp_path / "other")
    for content, mode, words in (
        (b"short", 0o600, "5 bytes"),
        (b"x" * 65, 0o600, "65 bytes"),
        (b"x" * 32, 0o644, "044"),
    ):
        path.write_bytes(content)
        path.chmod(mode)
        with pytest.raises(InputError, match=words):
            read_key(path)


def test_a_program_of_the_same_user_finds_the_key_by_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("DEHYST_KEY")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    config = ServeConfig("demo")
    with caplog.at_level(logging.WARNING):
        assert [bool(own_authenticator()) for _ in range(2)] == [False, False]
    assert len(caplog.records) == 1
    assert str(default_key()) in caplog.text
    made = authenticator_of(config)
    assert made.path == tmp_path / "dehyst" / "key"
    assert own_authenticator().tag("a") == made.tag("a")
    # One that is named must be there.
    with pytest.raises(InputError, match="No such file"):
        own_authenticator(tmp_path / "no")
    monkeypatch.setenv("DEHYST_KEY", str(tmp_path / "no"))
    with pytest.raises(InputError, match="No such file"):
        own_authenticator()
    monkeypatch.setenv("DEHYST_KEY", "-")
    assert not own_authenticator()
    assert not authenticator_of(config)


def test_a_service_that_can_keep_no_key_signs_and_a_pair_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("DEHYST_KEY", str(tmp_path / "file" / "key"))
    alone = ServeConfig("demo")
    with caplog.at_level(logging.WARNING):
        assert authenticator_of(alone).tag("a") != authenticator_of(alone).tag("a")
    assert "cannot be written" in caplog.text
    for config, standby in ((alone, True), (replace(alone, standby_listen=("tcp/127.0.0.1:7449",)), False)):
        with pytest.raises(InputError, match=r"key: got nothing, .*cannot be written"):
            authenticator_of(config, standby)
    with pytest.raises(InputError, match=r"key: got .*No such file"):
        authenticator_of(replace(alone, key=tmp_path / "missing"))


def test_an_open_service_warns(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert not authenticator_of(ServeConfig("demo", open=True))
    assert "everybody on the wire is believed" in caplog.text
