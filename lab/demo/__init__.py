"""The demonstration: one reference, five models on twin stages, a change half way, and a table at the end.

`run` runs it as the `Plan` says and returns a `DemoRun`; `table` shows the result. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dehyst.adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from dehyst.lab.demo.plan import Plan as Plan
    from dehyst.lab.demo.result import DemoRun as DemoRun
    from dehyst.lab.demo.result import table as table
    from dehyst.lab.demo.session import run as run

__getattr__ = lazy_names(__name__)
