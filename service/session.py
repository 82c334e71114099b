"""Opens zenoh sessions the way this project wants them: unicast, explicit endpoints, nothing beyond the machine.

Client programs use mode ``client``, because two peers behind one hub do not see each other while clients do. Every
session is to be closed by hand (``with``, or ``close()``): a callback left behind on an open session keeps the
interpreter from ending, and ``atexit`` comes too late for it.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import zenoh

from service.errors import FieldError, SessionError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
#: One network thread and no hand-over between thread pools: halves the round trip (docs/protocol.md, "Latency").
#: Sending has a thread of its own: a service passes messages on between its clients, and a receiver that waits
#: for room to send, on the very thread that would make that room, stops the whole service for good.
_RUNTIME: Final = (
    "(net:(worker_threads:1),app:(handover:net),acc:(handover:net),tx:(worker_threads:1),rx:(handover:net))"
)
_ENDPOINT = re.compile(
    r"(?P<proto>tcp|udp|tls|quic|ws)/(?P<host>\[[0-9a-fA-F:]+\]|[^/:\[\]]+):(?P<port>\d{1,5})(?:[?#].*)?\Z"
)
_LOCAL = re.compile(r"unixsock-stream/.+\Z")
_RETRY_S: Final = 0.05


def check_endpoint(field: str, endpoint: object) -> str:
    """``endpoint`` if zenoh can listen at or connect to it, else InputError naming ``field``."""
    expected = "protocol/host:port such as tcp/127.0.0.1:7447"
    if not isinstance(endpoint, str):
        raise FieldError(field, repr(endpoint), expected)
    match = _ENDPOINT.match(endpoint)
    if not match and not _LOCAL.match(endpoint):
        raise FieldError(field, repr(endpoint), expected)
    if match and not 1 <= int(match["port"]) <= 65535:
        raise FieldError(field, repr(endpoint), "a port from 1 to 65535")
    return endpoint


def is_loopback(endpoint: str) -> bool:
    """Whether ``endpoint`` can be reached from this machine only."""
    match = _ENDPOINT.match(endpoint)
    if not match:
        return bool(_LOCAL.match(endpoint))
    host = match["host"].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_service(listen: Sequence[str], connect: Sequence[str] = (), zenoh_config: Path | None = None) -> zenoh.Session:
    """A peer that listens at ``listen`` and connects to ``connect`` (routers, other services).

    ``zenoh_config`` is a JSON5 file of zenoh's own, for TLS, passwords and access control; what is given here goes
    over it. Raises SessionError where an endpoint cannot be had, such as a port in use.
    """
    return _open("peer", listen, connect, zenoh_config)


def open_client(
    endpoint: str = DEFAULT_ENDPOINT, wait_s: float = 0.0, zenoh_config: Path | None = None
) -> zenoh.Session:
    """A client connected to ``endpoint``, tried for ``wait_s`` seconds. Raises SessionError if nobody is there."""
    check_endpoint("endpoint", endpoint)
    until = time.monotonic() + wait_s
    while True:
        try:
            return _open("client", (), (endpoint,), zenoh_config)
        except SessionError:
            if time.monotonic() >= until:
                raise
            time.sleep(_RETRY_S)


def _open(mode: str, listen: Sequence[str], connect: Sequence[str], zenoh_config: Path | None) -> zenoh.Session:
    # Read once, when zenoh starts its threads, hence before the first session of the process.
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    for endpoint in (*listen, *connect):
        check_endpoint("endpoint", endpoint)
    try:
        config = zenoh.Config.from_file(zenoh_config) if zenoh_config else zenoh.Config()
    except zenoh.ZError as error:
        raise SessionError(f"{zenoh_config}: not a configuration of zenoh: {_plain(error)}") from error
    settings: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SessionError(_advice(str(error), listen, connect)) from error


def _advice(text: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    if "Address already in use" in text:
        return f"cannot listen at {', '.join(listen)}: the port is in use; stop what holds it or choose another port"
    if "Unable to connect" in text:
        return f"nobody listens at {', '.join(connect)}: start 'dehyst serve' there, or give its endpoint"
    return f"cannot open a zenoh session (listen {list(listen)}, connect {list(connect)}): {_plain(text)}"


def _plain(error: object) -> str:
    """A message of zenoh without the places in its sources."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error)).strip()
