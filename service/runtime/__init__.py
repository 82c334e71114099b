"""Parts of every process of the service: sessions, delivery of messages, memory, a clean stop, logging.

`open_client`, `open_service` and `open_router` open zenoh sessions, `StopSignal` ends a process on a signal,
`set_up_logging` formats the log. The names are loaded on first use: not all of these modules need zenoh.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.runtime.logging_setup import set_up_logging
    from service.runtime.session import DEFAULT_ENDPOINT, check_endpoint, open_client, open_router, open_service
    from service.runtime.stopping import StopSignal

_MODULES = {
    "DEFAULT_ENDPOINT": "session",
    "StopSignal": "stopping",
    "check_endpoint": "session",
    "open_client": "session",
    "open_router": "session",
    "open_service": "session",
    "set_up_logging": "logging_setup",
}
__all__ = [
    "DEFAULT_ENDPOINT",
    "StopSignal",
    "check_endpoint",
    "open_client",
    "open_router",
    "open_service",
    "set_up_logging",
]

__getattr__ = lazy_names(__name__, _MODULES)
