"""`dnnmso scenarios`, `controllers`, `new` and `schema`: what ships, and what to begin from."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from dnnmso_mj.cli.completing import complete_controller, complete_scenario
from dnnmso_mj.cli.shared import Json, near, number, print_table


def schema() -> None:
    """Print the JSON Schema of a scenario."""
    from dnnmso_mj.loading import scenario_schema

    print(json.dumps(scenario_schema(), indent=2))


def scenarios(as_json: Json = False) -> None:
    """List the scenarios that ship: what drives, how long, and what is made hard."""
    from dnnmso_mj.catalogue import shipped_scenarios

    found = shipped_scenarios()
    if as_json:
        print(json.dumps([asdict(item) for item in found]))
        return
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("name", style="cyan", no_wrap=True)
    table.add_column("controller", no_wrap=True)
    table.add_column("s", justify="right", no_wrap=True)
    table.add_column("description, and what is not perfect")
    for item in found:
        hard = ", ".join([*item.imperfections, *item.events])
        text = f"{item.description} [{hard}]" if hard else item.description
        table.add_row(item.name, item.controller, f"{item.duration:g}", text)
    print_table(table, wide=True)


def controllers(as_json: Json = False) -> None:
    """List the kinds of controllers, and the tuned ones that ship."""
    from dnnmso_mj.catalogue import kinds, tuned_controllers

    every, tuned = kinds(), tuned_controllers()
    if as_json:
        print(json.dumps({
            "kinds": [asdict(item) for item in every], "tuned": [asdict(item) for item in tuned]
        }))  # fmt: skip
        return
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("kind", style="cyan", no_wrap=True)
    for name in ("what it is", "source", "what it is told of the robot"):
        table.add_column(name)
    for item in every:
        table.add_row(item.kind, item.what, item.source, item.told)
    print_table(table, wide=True)
    print()
    table = Table(box=None, pad_edge=False, header_style="bold")
    table.add_column("tuned", style="cyan", no_wrap=True)
    table.add_column("kind", no_wrap=True)
    table.add_column("tuned on")
    for name in ("trials", "objective"):
        table.add_column(name, justify="right", no_wrap=True)
    for one in tuned:
        trials = "" if one.trials is None else str(one.trials)
        value = "" if one.value is None else number(one.value)
        table.add_row(one.name, one.kind, one.scenario or "by hand", trials, value)
    print_table(table, wide=True)
    print("in a scenario: controller: {kind: KIND} or {from: TUNED}; one to start from: dnnmso new")


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Of the scenario and its file.")],
    source: Annotated[
        str,
        typer.Option(
            "--from",
            metavar="SCENARIO",
            autocompletion=complete_scenario,
            help="What it is as at first: a scenario file, or the name of a shipped one.",
        ),
    ] = "paper",
    controller: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            autocompletion=complete_controller,
            help="Another controller: a kind, a shipped tuned one, or a file.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The file; default NAME.yaml.")] = None,
) -> None:
    """Write a commented scenario to start from."""
    from dnnmso_mj.new_scenario import new_scenario

    file = near(new_scenario(name, source, controller, out))
    print(f"scenario {file}")
    print(f"run      dnnmso run {file}")
