"""``dehyst completion``: the completion script of a shell, which then completes without starting Python.

Make the folders first where they are missing:

  mkdir -p ~/.local/share/bash-completion/completions ~/.zfunc ~/.config/fish/completions

  dehyst completion bash > ~/.local/share/bash-completion/completions/dehyst
  dehyst completion zsh > ~/.zfunc/_dehyst                # a folder of $fpath
  dehyst completion fish > ~/.config/fish/completions/dehyst.fish
  dehyst completion tcsh > ~/.dehyst.tcsh                 # and source it from ~/.tcshrc

The script holds commands and options of this version: print it again after an update.
"""

from __future__ import annotations

import argparse

from dehyst.service.cli.main import build_parser


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish", "tcsh"), help="the shell")


def run(args: argparse.Namespace) -> int:
    """Print the script. Returns 0."""
    import shtab

    print(shtab.complete(build_parser(args.commands, args.commands), args.shell))
    return 0
