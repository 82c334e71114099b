"""Background work of a service: processes of low priority that re-tune a model or diagnose a change of the stage.

`Watcher` keeps the recent samples of an axis, raises an alarm and starts a diagnosis, as `WatchConfig` says. `Retuner`
re-tunes the learner, as `RetuningConfig` says; a `Retuned` is an adoption at a definite sample, and `Adoptions` applies
it. `BackgroundJob` starts a process and waits for it; `run_worker` is the main function of the process. The names are
loaded on first use: the configuration needs the settings only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.background.job import BackgroundJob as BackgroundJob
    from dehyst.service.background.job import run_worker as run_worker
    from dehyst.service.background.job import step_back as step_back
    from dehyst.service.background.retuner import Adoptions as Adoptions
    from dehyst.service.background.retuner import Retuned as Retuned
    from dehyst.service.background.retuner import Retuner as Retuner
    from dehyst.service.background.settings import RetuningConfig as RetuningConfig
    from dehyst.service.background.settings import WatchConfig as WatchConfig
    from dehyst.service.background.watcher import Watcher as Watcher

__getattr__ = lazy_names(__name__)
