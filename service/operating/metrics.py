"""The status of all axes as metrics of Prometheus: ``page`` makes the text, ``serve_page`` serves it over HTTP.

Each reading asks the services anew, so a page never shows what is no longer so. An axis that does not answer is
missing, and ``dehyst_up`` tells how many instances answered.
"""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from dehyst.adaptive.errors import InputError

_LABELS: Final = ("stage", "axis", "role", "instance")
#: Name, kind, help, and the way to the value in a status.
_PLAIN: Final = (
    ("dehyst_samples_received", "counter", "samples received", ("samples", "received")),
    ("dehyst_samples_learnt", "counter", "samples learnt from", ("samples", "learnt")),
    ("dehyst_samples_lost", "counter", "sample numbers lost on the way", ("samples", "lost")),
    ("dehyst_samples_thinned", "counter", "samples left out: the learner cannot keep up", ("samples", "thinned")),
    ("dehyst_samples_dropped", "counter", "samples dropped: too many waited", ("samples", "dropped")),
    ("dehyst_samples_malformed", "counter", "messages that could not be decoded", ("samples", "malformed")),
    ("dehyst_samples_waiting", "gauge", "samples that wait to be learnt", ("samples", "waiting")),
    ("dehyst_sample_age_seconds", "gauge", "age of the newest sample handled, s", ("sample_age_s",)),
    ("dehyst_sample_rate_hertz", "gauge", "samples received per second over the last 10 s", ("rate_per_s",)),
    ("dehyst_thinning_factor", "gauge", "one of so many stretches of samples is learnt", ("thinning",)),
    ("dehyst_error_percent", "gauge", "recent rms error of the model, % of the voltage span",
     ("quality", "recent_rms_error_pct")),
    ("dehyst_stated_deviation_volts", "gauge", "standard deviation that the model states, V", ("quality", "std_V")),
    ("dehyst_within_stated_deviation_ratio", "gauge", "share of errors within one stated deviation",
     ("quality", "share_within_std")),
    ("dehyst_model_gain_ratio", "gauge", "gain of the stage relative to the identified one", ("quality", "gain")),
    ("dehyst_trust_ratio", "gauge", "weight of the learning model, 0 to 1", ("trust",)),
    ("dehyst_frozen", "gauge", "1 while an operator has stopped the learning", ("frozen",)),
    ("dehyst_stale", "gauge", "1 while no fresh samples are known", ("stale",)),
    ("dehyst_queries", "counter", "feedforward queries answered or refused", ("queries", "count")),
    ("dehyst_query_errors", "counter", "feedforward queries refused", ("queries", "errors")),
    ("dehyst_checkpoint_age_seconds", "gauge", "age of the newest checkpoint, s", ("checkpoints", "age_s")),
    ("dehyst_checkpoint_errors", "counter", "checkpoints that could not be written", ("checkpoints", "errors")),
    ("dehyst_recorder_written", "counter", "samples recorded", ("recorder", "written")),
    ("dehyst_recorder_lost", "counter", "samples not recorded: the disk failed", ("recorder", "lost")),
    ("dehyst_recorder_degraded", "gauge", "1 while recordings cannot be written", ("recorder", "degraded")),
    ("dehyst_memory_resident_bytes", "gauge", "resident memory of the serving process", ("memory", "resident_bytes")),
)  # fmt: skip


def page(statuses: Iterable[dict[str, Any]]) -> bytes:
    """The metrics of all statuses in the text format of Prometheus. Raises InputError without prometheus_client."""
    try:
        from prometheus_client import CollectorRegistry, generate_latest
    except ImportError as error:
        raise InputError(
            "metrics need the package prometheus_client, which is not installed here: "
            "python -m pip install prometheus-client"
        ) from error
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(list(statuses)))
    return bytes(generate_latest(registry))


class _Collector:
    """What prometheus_client asks for the metrics."""

    def __init__(self, statuses: list[dict[str, Any]]) -> None:
        self._statuses = statuses

    def collect(self) -> Iterator[Any]:
        """All metrics of the statuses that were given."""
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        yield GaugeMetricFamily("dehyst_up", "instances that answered", value=len(self._statuses))
        for name, kind, text, path in _PLAIN:
            made = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
            family = made(name, text, labels=_LABELS)
            for status in self._statuses:
                if (value := _number(status, path)) is not None:
                    family.add_metric(_labels(status), value)
            yield family
        refused = CounterMetricFamily("dehyst_samples_verdict", "samples by verdict", labels=(*_LABELS, "verdict"))
        state = GaugeMetricFamily("dehyst_state", "1 for the state that the axis is in", labels=(*_LABELS, "state"))
        healthy = GaugeMetricFamily("dehyst_healthy", "1 while the state is ok", labels=_LABELS)
        latency = GaugeMetricFamily(
            "dehyst_query_seconds", "time of a query inside the service", labels=(*_LABELS, "quantile")
        )
        trouble = GaugeMetricFamily(
            "dehyst_trouble", "1 while there is this trouble, with the reason", labels=(*_LABELS, "trouble", "why")
        )
        which = GaugeMetricFamily(
            "dehyst_answering", "1 for the model that answers by default", labels=(*_LABELS, "answering")
        )
        for status in self._statuses:
            labels = _labels(status)
            if answering := status.get("answering"):
                which.add_metric((*labels, str(answering)), 1.0)
            if name := str(status.get("trouble") or ""):
                trouble.add_metric((*labels, name, str(status.get("trouble_why", ""))), 1.0)
            gates = status.get("samples", {}).get("gates", {})
            for verdict, count in gates.items() if isinstance(gates, dict) else ():
                refused.add_metric((*labels, str(verdict)), float(count))
            word = str(status.get("state", "unknown"))
            state.add_metric((*labels, word.split(" 1/")[0]), 1.0)
            healthy.add_metric(labels, float(word == "ok"))
            for name, quantile in (("p50_us", "0.5"), ("p99_us", "0.99")):
                if (value := _number(status, ("queries", name))) is not None:
                    latency.add_metric((*labels, quantile), 1e-6 * value)
        yield from (refused, state, healthy, trouble, which, latency)


def _labels(status: dict[str, Any]) -> tuple[str, ...]:
    return tuple(str(status.get(name, "")) for name in _LABELS)


def _number(status: dict[str, Any], path: tuple[str, ...]) -> float | None:
    value: Any = status
    for name in path:
        value = value.get(name) if isinstance(value, dict) else None
    return float(value) if isinstance(value, bool | int | float) else None


#: Longest time for reading a request, and for sending the page, s; and the most connections at a time.
REQUEST_S: Final = 5.0
MOST_CONNECTIONS: Final = 16


class _Server(ThreadingHTTPServer):
    """Closes at once what comes while there are `MOST_CONNECTIONS`."""

    request_queue_size = 128

    def __init__(self, *args: Any) -> None:
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        super().__init__(*args)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, *_: object) -> None:
        """Print nothing where a client has gone away."""


class _Request(io.RawIOBase):
    """What a connection sends in `REQUEST_S`. The timeout of a socket alone begins anew with each byte."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._until = time.monotonic() + REQUEST_S

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        rest_s = self._until - time.monotonic()
        if rest_s <= 0.0:
            raise TimeoutError
        self._connection.settimeout(rest_s)
        return self._connection.recv_into(buffer)


@contextlib.contextmanager
def serve_page(address: str, port: int, collect: Callable[[], bytes]) -> Iterator[int]:
    """Serve what ``collect`` returns at ``/metrics`` while the block runs; gives the port. Raises InputError."""

    class Handler(BaseHTTPRequestHandler):
        def setup(self) -> None:
            super().setup()
            self.rfile.close()
            self.rfile = io.BufferedReader(_Request(self.connection))

        def do_GET(self) -> None:
            self.connection.settimeout(REQUEST_S)  # of all that is sent
            if self.path.split("?")[0] not in ("/", "/metrics"):
                self.send_error(404, "the page is /metrics")
                return
            try:
                body = collect()
            except Exception as error:  # one reading that fails must not end the server
                self.send_error(503, f"{type(error).__name__}: {error}"[:200])
                return
            self.send_response(200)
            self.send_header("Content-Type", "text/plain; version=0.0.4; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Print nothing for each reading."""

    page(())  # says at once that the package is missing
    try:
        server = _Server((address, port), Handler)
    except OSError as error:
        raise InputError(
            f"--port {port}: cannot listen at {address} ({error.strerror}): choose another port, or 0 for a free one"
        ) from error
    thread = threading.Thread(target=server.serve_forever, name="metrics")
    thread.start()
    try:
        yield int(server.server_address[1])
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
