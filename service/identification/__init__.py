"""Identification of the served models from a recording, with held-out scores and a picture.

`identify_all` identifies and scores; `draw_identification` draws; `recording_options` has the command-line options for
recordings. The names are loaded on first use, because the options are needed without the models.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.identification.identifying import Identified as Identified
    from dehyst.service.identification.identifying import Stretch as Stretch
    from dehyst.service.identification.identifying import draw_identification as draw_identification
    from dehyst.service.identification.identifying import identify_all as identify_all
    from dehyst.service.identification.identifying import identify_one as identify_one

__getattr__ = lazy_names(__name__)
