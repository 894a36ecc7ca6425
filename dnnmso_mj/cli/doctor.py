"""`dnnmso doctor`: what is missing on this machine, and how to get it."""

from __future__ import annotations

import typer

from dnnmso_mj.cli.shared import Json

BROKEN = 1


def doctor(as_json: Json = False) -> None:
    """Say what is missing on this machine and how to get it."""
    from dnnmso_mj.doctor import document, examine, is_well, words

    findings = examine()
    if as_json:
        print(document(findings))
    else:
        for line in words(findings):
            print(line)
    if not is_well(findings):
        raise typer.Exit(BROKEN)
