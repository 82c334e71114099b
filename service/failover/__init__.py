"""Failover of an axis: one instance serves, standbys hold the same model, and one of them takes over if it fails.

`role_control` decides the role of an instance, `standby_model` keeps the model of a standby equal to the served one and
reads what the other instance has left on the disk, `state_transfer` is what instances ask each other. The names
are loaded on first use: the server needs some of these modules, and `role_control` needs the server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.failover.role_control import Reachability as Reachability
    from service.failover.role_control import RoleControl as RoleControl
    from service.failover.standby_model import PeerFiles as PeerFiles
    from service.failover.standby_model import standby_folder as standby_folder

__getattr__ = lazy_names(__name__)
