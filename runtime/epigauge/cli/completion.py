"""``epigauge completion``: scripts by which shells complete commands, options and their choices."""

from __future__ import annotations

from typing import Annotated

import typer
from typer.completion import get_completion_script  # type: ignore[attr-defined]

from epigauge._arguments import as_choice
from epigauge.cli._common import DONE

#: Set by these scripts to ask for what could follow.
VARIABLE = "_EPIGAUGE_COMPLETE"


def completion(
    shell: Annotated[str, typer.Argument(help="bash, zsh or fish.", show_default=False)],
) -> int:
    """Write the script that lets a shell complete this program.

    bash: eval "$(epigauge completion bash)" in ~/.bashrc; zsh: the same in
    ~/.zshrc, after compinit; fish: epigauge completion fish | source.
    """
    name = as_choice("shell", shell, ("bash", "zsh", "fish"))
    typer.echo(get_completion_script(prog_name="epigauge", complete_var=VARIABLE, shell=name))
    return DONE
