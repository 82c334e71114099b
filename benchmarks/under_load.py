"""Whether the service withstands on a busy machine what it withstands on a quiet one.

``python -m benchmarks.under_load`` runs the tests of twenty attacks and faults on loopback, beside eight processes that
compute without end, and prints a line for each.
"""

from __future__ import annotations

import argparse
import subprocess
import sys

import pytest

#: What is withstood, and its tests below the folder ``tests``.
ROWS = {
    "1 2 9 wrong samples": "service/intake/test_command_witness.py "
    "foreign/test_learns_everywhere.py::test_samples_that_are_not_what_was_commanded_move_nothing "
    "service/server/test_model_watch.py::test_what_is_refused_teaches_and_moves_nothing",
    "3 4 5 8 strangers": "service/security/test_liars.py",
    "6 7 limits": "service/answers/test_narrower_limits.py",
    "10 two controllers": "service/security/test_lease.py",
    "11 another model file": "service/failover/test_restart.py::"
    "test_a_checkpoint_of_another_model_file_is_refused_and_the_file_serves",
    "12 shared folders": "service/storage/test_owner.py",
    "13 huge arrays": "service/storage/test_folders.py::"
    "test_a_small_file_that_declares_a_large_array_is_refused_before_anything_is_allocated",
    "14 few descriptors": "service/runtime/test_descriptors.py",
    "15 slow connections": "service/operating/test_metrics.py::test_connections_that_send_slowly_end_and_are_few",
    "16 a full disk": "service/storage/test_disk_failures.py",
    "17 a stop behind": "service/failover/test_restart.py::"
    "test_what_waits_at_a_stop_is_recorded_and_learnt_by_the_next_start",
    "18 counted samples": "service/server/test_health.py lab/soak/test_judge.py",
    "19 wrong rounding": "service/server/test_deltas.py",  # changes name their model by a checksum of its bytes
    "20 a busy demo": "service/stage_node/test_lock_step.py "
    "e2e/test_demo.py::test_no_voltage_is_late_beside_busy_processes_and_the_end_says_what_that_took",
}


class Outcomes:
    """A plugin of pytest: whether each test failed, by its node id."""

    def __init__(self) -> None:
        self.failed: dict[str, bool] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.failed[report.nodeid] = self.failed.get(report.nodeid, False) or report.failed


def main(arguments: list[str] | None = None) -> int:
    """Run the tests; prints how each row ended. Returns the exit code of pytest."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.under_load", description=__doc__)
    parser.add_argument("--busy", type=int, default=8, metavar="N", help="processes that compute meanwhile (8)")
    parser.add_argument("rows", nargs="*", metavar="ROW", help="numbers of rows (all)")
    given, outcomes = parser.parse_args(arguments), Outcomes()
    rows = {name: tests for name, tests in ROWS.items() if not given.rows or {*given.rows} & {*name.split()}}
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(given.busy)]
    try:
        paths = [f"tests/{test}" for tests in rows.values() for test in tests.split()]
        # The limit of a test's time is for a machine that is not this busy.
        options = ["-q", "--durations=10", "-o", "timeout=900", "-p", "no:cacheprovider"]
        code = pytest.main([*options, *paths], plugins=[outcomes])
    finally:
        for process in busy:
            process.kill()
            process.wait()
    for name, tests in rows.items():
        begins = tuple(f"tests/{test}" for test in tests.split())
        failed = [bad for one, bad in outcomes.failed.items() if one.startswith(begins)]
        print(f"{name}: {'FAILED' if any(failed) else 'held' if failed else 'not run'} ({len(failed)} tests)")
    return int(code)


if __name__ == "__main__":
    raise SystemExit(main())
