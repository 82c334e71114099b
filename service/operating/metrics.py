"""The status of all axes as metrics of Prometheus: ``page`` makes the text, ``serve_page`` serves it over HTTP.

Each reading asks the services anew, so a page is never out of date. An axis that does not answer is
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
from dehyst.service.operating.remote import entry

#: Labels of every metric of an axis.
_LABELS: Final = ("stage", "axis", "role", "instance")
#: The values of one metric in a status, each after the values of the metric's own labels.
_Values = Iterable[tuple[tuple[str, ...], Any]]


def _at(*path: str) -> Callable[[dict[str, Any]], _Values]:
    return lambda status: [((), entry(status, *path))]


def _verdicts(status: dict[str, Any]) -> _Values:
    gates = entry(status, "samples", "gates")
    return [((str(verdict),), count) for verdict, count in gates.items()] if isinstance(gates, dict) else []


def _seconds(status: dict[str, Any]) -> _Values:
    for name, quantile in (("p50_us", "0.5"), ("p99_us", "0.99")):
        if isinstance(value := entry(status, "queries", name), int | float):
            yield (quantile,), 1e-6 * value


def _troubles(status: dict[str, Any]) -> _Values:
    name = str(status.get("trouble") or "")
    return [((name, str(status.get("trouble_why", ""))), 1)] if name else []


#: Name, kind, help, what gives its values, and its own labels.
_METRICS: Final = (
    ("dehyst_samples_received", "counter", "samples received", _at("samples", "received")),
    ("dehyst_samples_learnt", "counter", "samples learnt from", _at("samples", "learnt")),
    ("dehyst_samples_lost", "counter", "sample numbers lost on the way", _at("samples", "lost")),
    ("dehyst_samples_thinned", "counter", "samples left out: the learner cannot keep up", _at("samples", "thinned")),
    ("dehyst_samples_dropped", "counter", "samples dropped: too many waited", _at("samples", "dropped")),
    ("dehyst_samples_malformed", "counter", "messages that could not be decoded", _at("samples", "malformed")),
    ("dehyst_samples_waiting", "gauge", "samples that wait to be learnt", _at("samples", "waiting")),
    ("dehyst_sample_age_seconds", "gauge", "age of the newest sample handled, s", _at("sample_age_s")),
    ("dehyst_sample_rate_hertz", "gauge", "samples received per second over the last 10 s", _at("rate_per_s")),
    ("dehyst_thinning_factor", "gauge", "one of so many stretches of samples is learnt", _at("thinning")),
    ("dehyst_error_percent", "gauge", "recent rms error of the model, % of the voltage span",
     _at("quality", "recent_rms_error_pct")),
    ("dehyst_stated_deviation_volts", "gauge", "standard deviation that the model states, V",
     _at("quality", "std_V")),
    ("dehyst_within_stated_deviation_ratio", "gauge", "share of errors within one stated deviation",
     _at("quality", "share_within_std")),
    ("dehyst_model_gain_ratio", "gauge", "gain of the stage relative to the identified one", _at("quality", "gain")),
    ("dehyst_trust_ratio", "gauge", "weight of the learning model, 0 to 1", _at("trust")),
    ("dehyst_frozen", "gauge", "1 while an operator has stopped the learning", _at("frozen")),
    ("dehyst_stale", "gauge", "1 while no fresh samples are known", _at("stale")),
    ("dehyst_queries", "counter", "feedforward queries answered or refused", _at("queries", "count")),
    ("dehyst_query_errors", "counter", "feedforward queries refused", _at("queries", "errors")),
    ("dehyst_checkpoint_age_seconds", "gauge", "age of the newest checkpoint, s", _at("checkpoints", "age_s")),
    ("dehyst_checkpoint_errors", "counter", "checkpoints that could not be written", _at("checkpoints", "errors")),
    ("dehyst_recorder_written", "counter", "samples recorded", _at("recorder", "written")),
    ("dehyst_recorder_lost", "counter", "samples not recorded: the disk failed", _at("recorder", "lost")),
    ("dehyst_recorder_degraded", "gauge", "1 while recordings cannot be written", _at("recorder", "degraded")),
    ("dehyst_memory_resident_bytes", "gauge", "resident memory of the serving process",
     _at("memory", "resident_bytes")),
    ("dehyst_samples_verdict", "counter", "samples by verdict", _verdicts, "verdict"),
    ("dehyst_state", "gauge", "1 for the state that the axis is in",
     lambda s: [((str(s.get("state", "unknown")).split(" 1/")[0],), 1)], "state"),
    ("dehyst_healthy", "gauge", "1 while the state is ok", lambda s: [((), s.get("state") == "ok")]),
    ("dehyst_trouble", "gauge", "1 while there is this trouble, with the reason", _troubles, "trouble", "why"),
    ("dehyst_answering", "gauge", "1 for the model that answers by default",
     lambda s: [((str(s["answering"]),), 1)] if s.get("answering") else [], "answering"),
    ("dehyst_query_seconds", "gauge", "time of a query inside the service", _seconds, "quantile"),
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
        for name, kind, text, read, *own in _METRICS:
            made = CounterMetricFamily if kind == "counter" else GaugeMetricFamily
            family = made(name, text, labels=(*_LABELS, *own))
            for status in self._statuses:
                labels = [str(status.get(label, "")) for label in _LABELS]
                for more, value in read(status):
                    if isinstance(value, int | float):
                        family.add_metric((*labels, *more), float(value))
            yield family


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
