"""Run the stage for a controller in another process: publish samples, apply what it commands. Ctrl-C ends it."""

import signal

from my_stage import open_stage

from dehyst import Client
from dehyst.service.adapters import StageLoop

with open_stage() as stage, Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x", wait_s=10.0) as client:
    loop = StageLoop(stage, client)
    # Not by KeyboardInterrupt: a vendor's library that catches all exceptions would swallow it.
    signal.signal(signal.SIGINT, lambda *_: loop.stop())
    print(f"ready: samples from number {loop.first} on", flush=True)  # the controller commands from there on
    loop.run()
