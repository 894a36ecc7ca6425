"""`dnnmso check`: MuJoCo held against the formula."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from dnnmso_mj.cli.shared import DIVERGED, Json, print_table, working


def check(
    states: Annotated[int, typer.Option(min=1, help="Random states for each model.")] = 10_000,
    model: Annotated[
        str, typer.Option(help="point_mass, rod, or an MJCF with bodies link1 and link2.")
    ] = "two_link",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the states and arms.")] = 0,
    as_json: Json = False,
) -> None:
    """Hold MuJoCo against the analytic M, V, G and accelerations."""
    from dnnmso_mj.check import TOLERANCE, check_dynamics
    from dnnmso_mj.dynamics import LINKS
    from dnnmso_mj.errors import ScenarioError
    from dnnmso_mj.paths import find_model
    from dnnmso_mj.plant import Mjcf
    from dnnmso_mj.wording import clean

    one = [links for links in LINKS if links == model]
    name = "two_link" if one else model
    try:
        mjcf = Mjcf.read(find_model(name))
        with working("comparing"):
            results = [check_dynamics(mjcf, links, states, seed, name) for links in one or LINKS]
    except ScenarioError as error:
        text = str(error).removeprefix("plant.model: ").removeprefix(f"plant.model = {name}: ")
        raise ScenarioError(f"--model {clean(model)}: {text}") from error
    passed = all(result.passed for result in results)
    if as_json:
        errors = {result.links: result.errors for result in results}
        document = {"status": "ok" if passed else "failed", "states": states, "seed": seed}
        print(json.dumps(document | {"tolerance": TOLERANCE, "max_relative_error": errors}))
    else:
        from rich.table import Table

        table = Table(title=f"MuJoCo against the formula: largest relative error, {states} states")
        for name in ("model", "M", "V", "G", "qdd", "verdict"):
            table.add_column(name)
        for result in results:
            cells = [f"{error:.1e}" for error in result.errors.values()]
            table.add_row(result.links, *cells, "ok" if result.passed else "FAILED")
        print_table(table)
        print(f"allowed: {TOLERANCE:g} for each")
    if not passed:
        raise typer.Exit(DIVERGED)
