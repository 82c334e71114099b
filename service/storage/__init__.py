"""Files of the service: recordings, checkpoints, model files.

`Recorder` writes the samples of an axis to a journal and to Parquet segments (`journal`, `segments`).
`CheckpointKeeper` writes checkpoints into a `CheckpointFolder`; `restore_newest` and `learn_again` restore an axis
from both. `read_bundle` and `write_bundle` are for model files, `atomic_write.atomic_write` for any file. The names
are loaded on first use: a model file needs no pyarrow and no server.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.storage.checkpoint import CheckpointFolder as CheckpointFolder
    from dehyst.service.storage.checkpoint import CheckpointKeeper as CheckpointKeeper
    from dehyst.service.storage.checkpoint import CheckpointMeta as CheckpointMeta
    from dehyst.service.storage.checkpoint import learn_again as learn_again
    from dehyst.service.storage.checkpoint import restore_newest as restore_newest
    from dehyst.service.storage.model_file import Bundle as Bundle
    from dehyst.service.storage.model_file import BundleMeta as BundleMeta
    from dehyst.service.storage.model_file import read_bundle as read_bundle
    from dehyst.service.storage.model_file import write_bundle as write_bundle
    from dehyst.service.storage.output import clear_output as clear_output
    from dehyst.service.storage.recorder import Recorder as Recorder
    from dehyst.service.storage.recorder import RecorderConfig as RecorderConfig

__getattr__ = lazy_names(__name__)
