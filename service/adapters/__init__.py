"""A stage of your own on the wire: an adapter for its controller, and the loop that runs it.

    from dehyst.service.adapters import StageLoop
    from dehyst.service.adapters.pi import PiStage
    from dehyst.service.client import Client

    with PiStage("192.168.0.10", axis="1", rate_Hz=200.0) as stage, Client.connect() as client:
        StageLoop(stage, client).run()  # publishes samples and applies the voltages of .../command

`StageAdapter` says what an adapter has to offer; write your own for any controller. Ready ones, through the vendors'
own libraries: `service.adapters.pi`, `service.adapters.jena`, `service.adapters.ni`. Names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.adapters.adapter import AdapterError as AdapterError
    from dehyst.service.adapters.adapter import StageAdapter as StageAdapter
    from dehyst.service.adapters.recording import excitation as excitation
    from dehyst.service.adapters.recording import record as record
    from dehyst.service.adapters.recording import write_recording as write_recording
    from dehyst.service.adapters.stage_loop import StageLoop as StageLoop

__getattr__ = lazy_names(__name__)
