"""`dnnmso completion`: the few lines that make a shell complete what is typed after `dnnmso`."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

# Of bash: readline takes "=" and ":" for ends of words, and puts a space behind what it completes.
# So the line is split by typer, as for fish, and what stands before the last of them is cut off.
_BASH = """\
_dnnmso_completion() {
    local IFS=$'\\n' line="${COMP_LINE:0:COMP_POINT}" word found
    COMPREPLY=()
    word="${line##*[[:space:]]}"
    while read -r found; do
        found="${found%%$'\\t'*}"
        case "$word" in *[=:]*) found="${found#"${word%[=:]*}"?}" ;; esac
        COMPREPLY+=("$found")
    done < <(_DNNMSO_COMPLETE=complete_fish _TYPER_COMPLETE_FISH_ACTION=get-args \\
        _TYPER_COMPLETE_ARGS="$line" "$1" 2>/dev/null)
    [[ ${#COMPREPLY[@]} == 1 && -z ${COMPREPLY[0]} ]] && COMPREPLY=()
    [[ ${COMPREPLY[0]} == *[=./] ]] && compopt -o nospace
}
complete -o default -F _dnnmso_completion dnnmso"""


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish"], typer.Argument(help="The shell that you type in.")
    ],
) -> None:
    """Print what makes a shell complete commands, names and keys.

    bash: eval "$(dnnmso completion bash)" in ~/.bashrc.

    zsh: eval "$(dnnmso completion zsh)" in ~/.zshrc, after compinit.

    fish: dnnmso completion fish > ~/.config/fish/completions/dnnmso.fish
    """
    from typer.completion import get_completion_script

    if shell == "bash":
        print(_BASH)
    else:
        variable = "_DNNMSO_COMPLETE"
        print(get_completion_script(prog_name="dnnmso", complete_var=variable, shell=shell))
