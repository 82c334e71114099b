"""Parts of every process of the service: sessions, delivery of messages, memory, a clean stop, logging.

`open_client`, `open_service` and `open_router` open zenoh sessions, `StopSignal` ends a process on a signal,
`set_up_logging` formats the log. The names are loaded on first use: not all of these modules need zenoh.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.runtime.logging_setup import set_up_logging as set_up_logging
    from dehyst.service.runtime.session import DEFAULT_ENDPOINT as DEFAULT_ENDPOINT
    from dehyst.service.runtime.session import check_endpoint as check_endpoint
    from dehyst.service.runtime.session import open_client as open_client
    from dehyst.service.runtime.session import open_router as open_router
    from dehyst.service.runtime.session import open_service as open_service
    from dehyst.service.runtime.stopping import StopSignal as StopSignal

__getattr__ = lazy_names(__name__)
