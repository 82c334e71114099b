"""The command line: groups, help, version, completion, log level and exit statuses."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lab.cli import COMMANDS, main
from service.cli.main import COMMANDS as SERVICE_COMMANDS
from service.cli.main import GROUPS, build_parser

ROOT = Path(__file__).resolve().parents[3]
DOCUMENTED = """
identify serve diagnose modes stage query replay status freeze thaw rollback checkpoints select retune ask-diagnosis
access router view demo rehearse scenarios soak bench reproduce
""".split()  # noqa: SIM905


@pytest.fixture(scope="module")
def parsers() -> dict[str, argparse.ArgumentParser]:
    whole = build_parser(COMMANDS, COMMANDS)
    (sub,) = [action for action in whole._actions if isinstance(action, argparse._SubParsersAction)]
    return dict(sub.choices)


def test_every_documented_command_is_there_with_help_and_a_log_level(
    parsers: dict[str, argparse.ArgumentParser],
) -> None:
    assert set(DOCUMENTED) <= set(parsers)
    for name, parser in parsers.items():
        text = parser.format_help()
        assert f"dehyst {name}" in text
        assert "--log-level" in text


def test_numbers_have_units(parsers: dict[str, argparse.ArgumentParser]) -> None:
    for name, parser in parsers.items():
        for action in parser._actions:
            if action.type is float and action.metavar == "S":
                assert re.search(r"\bs\b", action.help or ""), (name, action.option_strings)


def test_help_lists_all_commands_in_groups(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    text = capsys.readouterr().out
    assert ended.value.code == 0
    places = [text.index(f"\n{group}:\n") for group in GROUPS]
    assert places == sorted(places)
    for name in COMMANDS:
        assert re.search(rf"^  {name} ", text, re.MULTILINE)


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("dehyst")


def test_the_service_alone_has_no_experiments() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "serve" in done.stdout
    assert "soak" not in done.stdout
    assert set(SERVICE_COMMANDS) < set(COMMANDS)


@pytest.mark.parametrize(
    "args", [["dance"], [], ["query", "--speed", "3"], ["query", "1", "--log-level", "loud"], ["demo", "--seed", "-1"]]
)
def test_a_usage_error_ends_with_2_and_a_message(args: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    try:
        status = main(args)
    except SystemExit as ended:
        status = int(ended.code or 0)
    assert status == 2
    assert capsys.readouterr().err.startswith(("usage: dehyst", "dehyst demo: --seed: got -1, expected an integer"))


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_completion_knows_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for word in ("ask-diagnosis", "standby", "log-level"):
        assert word in script


def test_bash_completes_from_the_script(tmp_path: Path) -> None:
    script = tmp_path / "dehyst.bash"
    command = [sys.executable, "-m", "lab.cli", "completion", "bash"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    script.write_text(printed, encoding="utf-8")
    ask = (
        f'source {script}; COMP_WORDS=(dehyst serve --st); COMP_CWORD=2; COMP_LINE="dehyst serve --st"; '
        'COMP_POINT=${#COMP_LINE}; _shtab_dehyst; echo "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", ask], capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["--standby"], done.stderr
