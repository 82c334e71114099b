"""Client of a running service: queries (`Client`) and a model that is followed into this process (`Follower`).

    from service.client import Client

    with Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x") as client:
        u_V = client.point(y_um=40.0).u_V

The names are loaded on first use: `import service.client` alone loads neither zenoh nor a model.
"""

from __future__ import annotations

# Not from typing: that would double the import time of this package. mypy knows the name.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from service.client.client import Client
    from service.client.follower import Follower
    from service.protocol.reply import Point, Trajectory

__all__ = ["Client", "Follower", "Point", "Trajectory"]

_MODULES = {
    "Client": "service.client.client",
    "Follower": "service.client.follower",
    "Point": "service.protocol.reply",
    "Trajectory": "service.protocol.reply",
}


def __getattr__(name: str) -> object:
    import importlib

    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES[name]), name)
