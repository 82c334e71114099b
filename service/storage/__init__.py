"""Files of the service: recordings, checkpoints, model files.

`Recorder` writes the samples of an axis to a journal and to Parquet segments (`journal`, `segments`).
`CheckpointKeeper` writes checkpoints into a `CheckpointFolder`; `restore_newest` and `learn_again` restore an axis
from both. `read_bundle` and `write_bundle` are for model files, `atomic_write.atomic_write` for any file. The names
are loaded on first use: a model file needs no pyarrow and no server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.storage.checkpoint import (
        CheckpointFolder,
        CheckpointKeeper,
        CheckpointMeta,
        learn_again,
        restore_newest,
    )
    from service.storage.model_file import Bundle, BundleMeta, read_bundle, write_bundle
    from service.storage.output import clear_output
    from service.storage.recorder import Recorder, RecorderConfig

_MODULES = {
    "Bundle": "model_file",
    "BundleMeta": "model_file",
    "CheckpointFolder": "checkpoint",
    "CheckpointKeeper": "checkpoint",
    "CheckpointMeta": "checkpoint",
    "Recorder": "recorder",
    "RecorderConfig": "recorder",
    "clear_output": "output",
    "learn_again": "checkpoint",
    "read_bundle": "model_file",
    "restore_newest": "checkpoint",
    "write_bundle": "model_file",
}
__all__ = [
    "Bundle",
    "BundleMeta",
    "CheckpointFolder",
    "CheckpointKeeper",
    "CheckpointMeta",
    "Recorder",
    "RecorderConfig",
    "clear_output",
    "learn_again",
    "read_bundle",
    "restore_newest",
    "write_bundle",
]

__getattr__ = lazy_names(__name__, _MODULES)
