"""The online service: processes that learn the inverse of a stage and answer feedforward queries over zenoh.

``server`` is the serving process, ``client`` its client, ``protocol`` the wire, ``stage_node`` a simulated stage as a
process, ``viewer`` the viewer stream, and ``cli`` the command line; ``storage``, ``failover``, ``background``,
``security`` and ``operating`` are parts of the server. This package imports nothing by itself; import from the
subpackages.
"""

from __future__ import annotations

__all__: list[str] = []
