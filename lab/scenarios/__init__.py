"""Scenarios: adapting and not adapting on twin stages, judged window by window.

`run_scenario` runs one scenario, `judge` judges it, `table` shows the verdicts.
"""

from lab.scenarios.judgement import Verdict, judge, table
from lab.scenarios.run import ScenarioRecord, run_scenario

__all__ = ["ScenarioRecord", "Verdict", "judge", "run_scenario", "table"]
