"""Experiments on the service; nothing in ``service`` imports them.

``demo`` is the demonstration, ``soak`` runs all processes under faults, ``scenarios`` compare adapting with not
adapting, ``rehearsal`` tries the axis on a simulator of your own stage, ``reproduce`` computes the chapter again, and
``testbed`` starts the processes. ``lab.cli`` is ``dehyst``, with its commands in ``lab.commands``. This package imports
nothing by itself; import from the subpackages.
"""

from __future__ import annotations

__all__: list[str] = []
