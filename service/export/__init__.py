"""A model without the service: as a C file, as tables, and as an FMU for co-simulation.

The templates beside the modules are the C itself. Words in capitals that they do not define are filled in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.service.export.c_source import c_source as c_source
    from dehyst.service.export.exporting import Frozen as Frozen
    from dehyst.service.export.exporting import compiler as compiler
    from dehyst.service.export.exporting import write_export as write_export

__getattr__ = lazy_names(__name__)
