"""Identification of the served models from a recording, with held-out scores and a picture.

`identify_all` identifies and scores; `draw_identification` draws; `recording_options` has the command-line options for
recordings.
"""
