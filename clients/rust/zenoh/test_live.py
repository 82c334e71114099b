"""The native follower beside the Python follower of a live service, through the shared library's C interface.

``DEHYST_ZENOH_LIBRARY=.../libdehyst_zenoh.so python -m pytest clients/rust/zenoh/test_live.py`` from a checkout.
"""

from __future__ import annotations

import ctypes
import json
import os
import socket
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

import tests.conftest  # noqa: F401  the key that service and clients share
from dehyst.service.client.client import Client
from dehyst.service.protocol.errors import CommandHeldError
from dehyst.service.protocol.model import encode_model
from dehyst.service.protocol.query import Answer as Reply
from dehyst.service.protocol.query import decode_reply, encode_query, encode_reply
from dehyst.service.protocol.samples import encode_command
from tests.service.conftest import ServeProcess, make_models, unused_port, write_config
from tests.service.living import eventually

LIBRARY = os.environ.get("DEHYST_ZENOH_LIBRARY", "")
pytestmark = pytest.mark.skipif(not LIBRARY, reason="DEHYST_ZENOH_LIBRARY names no library: build clients/rust/zenoh")


class Answer(ctypes.Structure):
    _fields_ = (("u_V", ctypes.c_double), ("std_V", ctypes.c_double), ("flags", ctypes.c_uint32))


class Report(ctypes.Structure):
    _fields_ = (
        ("snapshot_seq", ctypes.c_int64), ("received", ctypes.c_uint64), ("refused", ctypes.c_uint64),
        ("answered", ctypes.c_uint64), ("age_s", ctypes.c_double), ("trust", ctypes.c_double),
        ("dt_s", ctypes.c_double), ("gain", ctypes.c_double), ("offset_um", ctypes.c_double), ("last", Answer),
        ("memory_size", ctypes.c_uint32), ("stale", ctypes.c_uint32), ("source", ctypes.c_char * 132),
    )  # fmt: skip


@pytest.fixture(scope="module")
def native() -> ctypes.CDLL:
    library = ctypes.CDLL(LIBRARY)
    library.dehyst_error.restype = ctypes.c_char_p
    library.dehyst_open.argtypes = [ctypes.c_char_p] * 4 + [ctypes.c_double, ctypes.POINTER(ctypes.c_void_p)]
    library.dehyst_point.argtypes = [ctypes.c_void_p] + [ctypes.c_double] * 3 + [ctypes.POINTER(Answer)]
    library.dehyst_warm.argtypes = [ctypes.c_void_p] + [ctypes.c_double] * 3
    library.dehyst_report.argtypes = [ctypes.c_void_p, ctypes.POINTER(Report)]
    library.dehyst_close.argtypes = [ctypes.c_void_p]
    library.dehyst_close.restype = None
    library.dehyst_link_open.argtypes = [*[ctypes.c_char_p] * 4, ctypes.c_double, ctypes.POINTER(ctypes.c_void_p)]
    library.dehyst_link_send.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_size_t]
    library.dehyst_take_command.argtypes = [ctypes.c_void_p, ctypes.c_int]
    library.dehyst_link_close.argtypes = [ctypes.c_void_p]
    library.dehyst_link_close.restype = None
    return library


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    port = unused_port()
    process = ServeProcess(write_config(tmp_path_factory.mktemp("live"), port, ("x", "y")), port)
    yield process.endpoint
    process.kill()


def stage_samples(first: int, n: int, gain: float) -> bytes:
    k = np.arange(first, first + n)
    u = 4.0 + 2.5 * np.sin(2 * np.pi * 4e-3 * k) + 0.8 * np.sin(2 * np.pi * 11e-3 * k)
    y = gain * (11.0 * u + 1.0)
    return struct.pack("<BBHI", 1, 1, 0, n) + struct.pack(f"<{n}q{3 * n}d", *k, *(k * 1e-3), *u, *y)


@pytest.mark.parametrize("model", [b"", b"lssvm_adaptive"])
def test_the_native_follower_is_the_python_follower(native: ctypes.CDLL, endpoint: str, model: bytes) -> None:
    handle, answer, report = ctypes.c_void_p(), Answer(), Report()
    begin = 0 if not model else 4000
    with Client.connect(endpoint) as client:
        opened = native.dehyst_open(endpoint.encode(), b"demo", b"x", model, 5.0, ctypes.byref(handle))
        assert opened == 0, native.dehyst_error()
        mine = client.follow(model.decode())
        session: zenoh.Session = client._session
        for k in range(begin, begin + 4000, 50):  # a gain of 0.94 from the middle on
            payload = stage_samples(k, 50, 1.0 if k % 4000 < 2000 else 0.94)
            session.put(f"{client.keys.base}/sample", payload, congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(0.01)
        assert mine.wait(begin + 3999, 60.0)

        def has_newest() -> bool:  # `dehyst_warm` takes the newest model and leaves the memory
            assert native.dehyst_warm(handle, 40.0, 0.0, 0.0) == 0, native.dehyst_error()
            assert native.dehyst_report(handle, ctypes.byref(report)) == 0
            return bool(report.snapshot_seq == begin + 3999)

        eventually(has_newest, 60.0)
        # Whatever came meanwhile, both go along the same motion from their memories of the start.
        for i in range(40):
            y, v = 40.0 + 10.0 * np.sin(0.1 * i), 1000.0 * np.cos(0.1 * i)
            assert native.dehyst_point(handle, y, v, 0.0, ctypes.byref(answer)) == 0, native.dehyst_error()
            assert answer.u_V == pytest.approx(mine.point(y, v), rel=1e-12, abs=1e-12)
            assert answer.std_V == pytest.approx(mine.last_std_V, rel=1e-12, abs=1e-12)
            assert answer.flags == mine.last_flags
        assert native.dehyst_report(handle, ctypes.byref(report)) == 0
        assert report.source.decode() == mine.source
        assert report.snapshot_seq == mine.snapshot_seq == begin + 3999
        assert report.received > 10
        assert report.refused == 0
        assert report.gain == pytest.approx(0.94, abs=0.01)
    native.dehyst_close(handle)


def test_a_liar_beside_the_service_is_not_believed(native: ctypes.CDLL, endpoint: str) -> None:
    handle, link, answer, size = ctypes.c_void_p(), ctypes.c_void_p(), Answer(), ctypes.c_size_t()
    native.dehyst_link_ask.argtypes = [
        ctypes.c_void_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_size_t, ctypes.c_char_p, ctypes.c_size_t,
        ctypes.POINTER(ctypes.c_size_t),
    ]  # fmt: skip
    with Client.connect(endpoint) as client:
        keys, session = client.keys, client._session
        honest = client.point(40.0, model="linear")
        status = client.status()
        status["limits"]["u_max_V"] = 1000.0
        lie = Reply(np.array([1e6]), np.zeros(1), np.zeros(1, dtype=np.uint8), np.zeros(0), 7, "linear")
        says = {keys.status: json.dumps(status).encode(), keys.feedforward: encode_reply(lie)}

        def tell(query: zenoh.Query) -> None:
            with query:
                query.reply(query.key_expr, says[str(query.key_expr)], attachment=query.attachment)

        liars = [session.declare_queryable(key, tell, complete=True) for key in says]
        time.sleep(0.3)
        assert native.dehyst_open(endpoint.encode(), b"demo", b"x", b"lssvm_adaptive", 5.0, ctypes.byref(handle)) == 0
        assert native.dehyst_link_open(endpoint.encode(), b"demo", b"x", None, 5.0, ctypes.byref(link)) == 0
        query, reply = encode_query(40.0, 0.0, 0.0, model="linear"), ctypes.create_string_buffer(10_000)
        for _ in range(20):
            asked = native.dehyst_link_ask(
                link, b"feedforward", query, len(query), reply, len(reply), ctypes.byref(size)
            )
            assert asked == 0, native.dehyst_error()
            assert decode_reply(reply.raw[: size.value]).u_V.item() == honest.u_V
        assert native.dehyst_point(handle, 40.0, 0.0, 0.0, ctypes.byref(answer)) == 0
        honest_V = answer.u_V
        model = make_models(1000.0)["lssvm_adaptive"]
        forged = encode_model("lssvm_adaptive", model, 10**9, np.zeros(model.memory_size))
        for _ in range(50):
            session.put(keys.model_delta, forged, attachment=bytes(32))
            time.sleep(1e-3)
        assert native.dehyst_point(handle, 40.0, 0.0, 0.0, ctypes.byref(answer)) == 0
        assert answer.u_V == pytest.approx(honest_V, abs=0.01)
        assert native.dehyst_point(handle, 80.0, 0.0, 0.0, ctypes.byref(answer)) == 0
        assert answer.u_V <= honest_V + 2.02
        for entity in liars:
            entity.undeclare()  # type: ignore[no-untyped-call]
    native.dehyst_link_close(link)
    native.dehyst_close(handle)


def test_what_c_sends_is_learnt_and_signed(native: ctypes.CDLL, endpoint: str) -> None:
    """A batch by one call: the service takes each sample, believes the sender's signature, and learns a new gain."""
    link = ctypes.c_void_p()
    native.dehyst_samples.argtypes = [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_void_p] * 4]
    assert native.dehyst_link_open(endpoint.encode(), b"demo", b"y", None, 5.0, ctypes.byref(link)) == 0
    with Client.connect(endpoint, axis="y") as client:
        before = client.point(40.0, model="lssvm_adaptive").u_V
        k = np.arange(4000)
        u = 4.0 + 2.5 * np.sin(2 * np.pi * 4e-3 * k) + 0.8 * np.sin(2 * np.pi * 11e-3 * k)
        for at in range(0, 4000, 50):
            columns = [k[at : at + 50], k[at : at + 50] * 1e-3, u[at : at + 50], 0.94 * (11.0 * u[at : at + 50] + 1.0)]
            assert native.dehyst_samples(link, 50, *(c.ctypes.data for c in columns)) == 0, native.dehyst_error()
            time.sleep(0.01)
        client.wait_learnt(3999, 60.0)
        status = client.status()
        assert (status["seq"], status["samples"]["received"]) == (3999, 4000)
        assert client.point(40.0, model="lssvm_adaptive").u_V > before + 0.1
        # Once signed samples came, those of somebody without the key are left out.
        client._session.put(client.keys.sample, stage_samples(4000, 50, 1.0))
        time.sleep(0.5)
        assert client.status()["samples"]["received"] == 4000
    for n, field in ((0, b"n:"), (70_000, b"n:")):
        wrong = np.zeros(max(n, 1))
        assert native.dehyst_samples(link, n, *[wrong.ctypes.data] * 4) == -1
        assert field in native.dehyst_error()
    assert native.dehyst_samples(link, 1, None, *[u.ctypes.data] * 3) == -1
    assert b"seq: got a null pointer" in native.dehyst_error()
    native.dehyst_link_close(link)


def test_one_controller_at_a_time_commands_from_c_too(native: ctypes.CDLL, endpoint: str) -> None:
    first, second = ctypes.c_void_p(), ctypes.c_void_p()
    for link in (first, second):
        assert native.dehyst_link_open(endpoint.encode(), b"demo", b"x", None, 5.0, ctypes.byref(link)) == 0
    voltages = encode_command(0, np.full(20, 4.0))

    def sends(link: ctypes.c_void_p) -> bool:
        return bool(native.dehyst_link_send(link, b"command", voltages, len(voltages)) == 0)

    me = f"process {os.getpid()} on ".encode()
    with Client.connect(endpoint) as client:
        assert sends(first)
        owner = eventually(lambda: client.status()["command"]["owner"], 20.0)
        assert (owner["process"], owner["host"]) == (os.getpid(), socket.gethostname())
        assert not sends(second)
        assert b"command: got a second controller, expected one: " + me in native.dehyst_error()
        with pytest.raises(CommandHeldError, match=rf"process {os.getpid()} on "):
            client.command(0, np.full(20, 4.0))
        assert sends(first)
        assert native.dehyst_take_command(second, 1) == 0
        assert sends(second)
        eventually(lambda: not sends(first), 20.0)  # it is told
        assert me in native.dehyst_error()
        native.dehyst_link_close(second)
        eventually(lambda: sends(first), 20.0)
        client.take_command(force=True)
        eventually(lambda: not sends(first), 20.0)
        client.command(0, np.full(20, 4.0))
        assert client.status()["command"]["refused"] == 0
    eventually(lambda: sends(first), 20.0)
    native.dehyst_link_close(first)


def test_a_controller_in_c_follows_at_its_sample_time(endpoint: str) -> None:
    program = Path(LIBRARY).parent / "controller"
    if not program.exists():
        pytest.skip("c/controller.c is not built: clients/test.sh does")
    words: list[str | Path] = [program, endpoint, "demo", "x", "", "1.0", "45", "20"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("1000 points, 0 refused")


@pytest.mark.parametrize("folder", ["examples", "."])
def test_a_stage_and_a_controller_that_asks_ahead_in_rust_and_in_c(endpoint: str, folder: str) -> None:
    examples = Path(LIBRARY).parent / folder
    if not (examples / "ahead").exists():
        pytest.skip("the programs are not built: clients/test.sh does")
    with Client.connect(endpoint) as client:
        received = client.status()["samples"]["received"]
        stage = subprocess.Popen(
            [examples / "stage", endpoint, "demo", "x", "2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        with stage:
            assert stage.stdout is not None
            assert stage.stdout.readline() == "ready\n"
            words: list[str | Path] = [examples / "ahead", endpoint, "demo", "x", "2", "45", "20"]
            done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
            assert done.returncode == 0, done.stderr
            assert done.stdout.startswith("2000 voltages")
            out, errors = stage.communicate(timeout=30)
            assert stage.returncode == 0, errors
        assert out.startswith("2000 samples")
        assert out.endswith("0 commands refused\n")
        eventually(lambda: client.status()["samples"]["received"] == received + 2000, 60.0)


@pytest.mark.parametrize("threads", [[], ["--receivers"], ["--core", "--warm"]])
def test_the_loop_that_counts_deadlines_runs_with_the_model_and_without(endpoint: str, threads: list[str]) -> None:
    """How many are missed, only a quiet machine can tell."""
    program = Path(LIBRARY).parent / "deadlines"
    if not program.exists():
        pytest.skip("c/deadlines.c is not built: clients/test.sh does")
    for model in ([], [endpoint, "demo", "x", "", "45", "20"]):
        words: list[str | Path] = [program, *threads, "0.5", "2000", *model]
        done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        assert told["turns"] == 1000
        assert told["refused"] == 0
        assert (told["models"] > 0) == bool(model)
        assert told["point_us"] == sorted(told["point_us"])
    for wrong in (["0.5"], ["--nope", "0.5", "2000"]):
        done = subprocess.run([program, *wrong], capture_output=True, text=True, timeout=30, check=False)
        assert done.returncode == 2
        assert done.stdout.startswith("usage")


def test_where_nobody_serves_the_error_says_what_to_check(native: ctypes.CDLL, endpoint: str) -> None:
    handle = ctypes.c_void_p()
    for where, axis, words in (
        (f"tcp/127.0.0.1:{unused_port()}", b"x", b"endpoint"),
        (endpoint, b"nobody", b"no reply"),
        (endpoint, b"X", b"axis"),
    ):
        assert native.dehyst_open(where.encode(), b"demo", axis, b"", 0.5, ctypes.byref(handle)) == -1
        assert words in native.dehyst_error()
    assert native.dehyst_open(endpoint.encode(), b"demo", b"x", b"sorcery", 2.0, ctypes.byref(handle)) == -1
    assert b"one of" in native.dehyst_error()
