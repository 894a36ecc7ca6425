"""`dnnmso schema` and `dnnmso scenarios`: what a scenario may hold, and which ones ship."""

from __future__ import annotations

import json

from dnnmso_mj.cli.shared import Json, print_table


def schema() -> None:
    """Print the JSON Schema of a scenario."""
    from dnnmso_mj.loading import scenario_schema

    print(json.dumps(scenario_schema(), indent=2))


def scenarios(as_json: Json = False) -> None:
    """List the scenarios that ship."""
    from dnnmso_mj.loading import list_scenarios

    found = list_scenarios()
    if as_json:
        print(json.dumps([{"name": name, "description": text} for name, text in found]))
        return
    from rich.table import Table

    table = Table("name", "description")
    for name, text in found:
        table.add_row(name, text)
    print_table(table)
