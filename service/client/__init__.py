"""Client of a running service: queries (`Client`) and a model that is followed into this process (`Follower`).

    from dehyst.service.client import Client

    with Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x") as client:
        u_V = client.point(y_um=40.0).u_V

The names are loaded on first use: `import service.client` alone loads neither zenoh nor a model.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.client.client import Client as Client
    from dehyst.service.client.follower import Follower as Follower
    from dehyst.service.protocol.query import Point as Point
    from dehyst.service.protocol.query import Trajectory as Trajectory

__getattr__ = lazy_names(__name__)
