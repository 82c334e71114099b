"""Files of the service: recordings, checkpoints, model files.

`Recorder` writes the samples of an axis to a journal and to Parquet segments (`segments`).
`CheckpointKeeper` writes checkpoints into a `CheckpointFolder`; `restore_newest` and `learn_again` restore an axis
from both. `read_bundle` and `write_bundle` are for model files, `output.atomic_write` for any file. A model file needs
no pyarrow and no server.
"""
