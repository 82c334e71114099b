"""Background work of a service: processes of low priority that re-tune a model or diagnose a change of the stage.

`Watcher` keeps the recent samples of an axis, raises an alarm and starts a diagnosis, as `WatchConfig` says. `Retuner`
re-tunes the learner, as `RetuningConfig` says; a `Retuned` is an adoption at a definite sample, and `Adoptions` applies
it. `BackgroundJob` starts a process and waits for it; `run_worker` is the main function of the process.
"""
