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
    from service.storage.checkpoint import CheckpointFolder as CheckpointFolder
    from service.storage.checkpoint import CheckpointKeeper as CheckpointKeeper
    from service.storage.checkpoint import CheckpointMeta as CheckpointMeta
    from service.storage.checkpoint import learn_again as learn_again
    from service.storage.checkpoint import restore_newest as restore_newest
    from service.storage.model_file import Bundle as Bundle
    from service.storage.model_file import BundleMeta as BundleMeta
    from service.storage.model_file import read_bundle as read_bundle
    from service.storage.model_file import write_bundle as write_bundle
    from service.storage.output import clear_output as clear_output
    from service.storage.recorder import Recorder as Recorder
    from service.storage.recorder import RecorderConfig as RecorderConfig

__getattr__ = lazy_names(__name__)
