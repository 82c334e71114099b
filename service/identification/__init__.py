"""Identification of the served models from a recording, with held-out scores and a picture.

`identifying` identifies and scores; `pictures` draws; `recording_options` are the command-line options for recordings.
Import from these modules: the package itself loads nothing, because the options are needed without the models.
"""

__all__: list[str] = []
