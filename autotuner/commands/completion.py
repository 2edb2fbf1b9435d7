"""`autotuner completion`: the completion script of a shell, made of the options that the commands declare."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner.commands.terminal.output import show
from autotuner.commands.terminal.usage import OneOf, add_examples, words

if TYPE_CHECKING:
    import argparse

SHELLS = ("bash", "zsh", "fish")
SENTENCE = 60
"""Longest description of a completion, characters."""


@dataclass(frozen=True, slots=True)
class Option:
    """An option: name, description and choices; `files` where it takes a path."""

    name: str
    text: str
    words: tuple[str, ...] = ()
    files: bool = False


@dataclass(frozen=True, slots=True)
class CompletionCommand:
    """Print a completion script."""

    help: str = "Print the completion script of a shell. Load it in the shell's start-up file."

    def configure(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        parser.add_argument("shell", type=words(*SHELLS), metavar="{bash,zsh,fish}", help="the shell")
        add_examples(
            parser,
            'eval "$(autotuner completion bash)"',
            "autotuner completion zsh > ~/.zfunc/_autotuner",
            "autotuner completion fish > ~/.config/fish/completions/autotuner.fish",
        )

    def run(self, args: argparse.Namespace) -> int:
        """Print it."""
        from autotuner.commands.command_line import command_line  # noqa: PLC0415 - the command line knows this command

        parser, _ = command_line(None, whole=True)
        commands = {
            name: tuple(_option(*option) for option in below.options().items())
            for name, below in parser.commands().items()
        }
        texts = {name: _sentence(below.description or "") for name, below in parser.commands().items()}
        show({"bash": bash, "zsh": zsh, "fish": fish}[args.shell](commands, texts))
        return 0


command = CompletionCommand()


def _option(name: str, action: argparse.Action) -> Option:
    names = action.type.names() if isinstance(action.type, OneOf) else tuple(action.choices or ())
    takes_file = action.metavar == "FILE" or str(action.metavar).endswith((".json", ".html"))
    return Option(name, _sentence((action.help or "") % vars(action)), tuple(map(str, names)), takes_file)


def _sentence(text: str) -> str:
    """Return the beginning of a description, without characters that shells interpret."""
    plain = "".join(" " if character in "'\"`$\\:[]()" else character for character in text.partition(". ")[0])
    return plain if len(plain) <= SENTENCE else plain[: SENTENCE - 3].rstrip() + "..."


def bash(commands: dict[str, tuple[Option, ...]], texts: dict[str, str]) -> str:
    """Return the script for bash."""
    options = "".join(
        f"    {name}) options={shlex.quote(' '.join(option.name for option in found))} ;;\n"
        for name, found in commands.items()
    )
    values = "".join(
        f"    {name},{option.name}) choose {shlex.quote(' '.join(option.words))}; return ;;\n"
        for name, found in commands.items()
        for option in found
        if option.words
    )
    return f"""# bash completion for autotuner
_autotuner() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} options=
  choose() {{ mapfile -t COMPREPLY < <(compgen -W "$1" -- "$word"); }}
  if [ "$COMP_CWORD" -eq 1 ]; then choose {shlex.quote(" ".join(texts))}; return; fi
  case "${{COMP_WORDS[1]}},$before" in
{values}  esac
  case "${{COMP_WORDS[1]}}" in
{options}  esac
  if [[ $word == -* ]]; then choose "$options"; else mapfile -t COMPREPLY < <(compgen -f -- "$word"); fi
}}
complete -o filenames -F _autotuner autotuner
"""


def zsh(commands: dict[str, tuple[Option, ...]], texts: dict[str, str]) -> str:
    """Return the script for zsh."""
    names = " ".join(f"'{name}:{text}'" for name, text in texts.items())
    cases = "".join(
        f"    {name}) _arguments {' '.join(_zsh_option(option) for option in found)} '*:file:_files' ;;\n"
        for name, found in commands.items()
    )
    return f"""#compdef autotuner
_autotuner() {{
  local -a names
  names=({names})
  if (( CURRENT == 2 )); then _describe command names; return; fi
  local chosen=$words[2]
  shift words; (( CURRENT-- ))
  case $chosen in
{cases}  esac
}}
if [ "$funcstack[1]" = _autotuner ]; then _autotuner "$@"; else compdef _autotuner autotuner; fi
"""


def _zsh_option(option: Option) -> str:
    value = f":value:({' '.join(option.words)})" if option.words else ":file:_files" if option.files else ""
    return f"'{option.name}[{option.text}]{value}'"


def fish(commands: dict[str, tuple[Option, ...]], texts: dict[str, str]) -> str:
    """Return the script for fish."""
    first = [f"complete -c autotuner -n __fish_use_subcommand -f -a {name} -d '{text}'" for name, text in texts.items()]
    others = [
        f"complete -c autotuner -n '__fish_seen_subcommand_from {name}' -l {option.name[2:]} -d '{option.text}'"
        + (f" -x -a '{' '.join(option.words)}'" if option.words else " -r" if option.files else "")
        for name, found in commands.items()
        for option in found
    ]
    return "\n".join(["# fish completion for autotuner", *first, *others]) + "\n"
