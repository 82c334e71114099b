"""Background work of a service: processes of low priority that re-tune a model or diagnose a change of the stage.

`BackgroundJob` starts such a process and waits for it; `run_worker` is the main function of the process.
"""

from __future__ import annotations

from service.background.job import BackgroundJob, run_worker, step_back

__all__ = ["BackgroundJob", "run_worker", "step_back"]
