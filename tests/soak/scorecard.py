"""The scorecard: results of the rows as a table in the terminal, and in docs/reliability.md."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from soak.rows import ROWS

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "reliability.json"
PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- scorecard -->\n", "<!-- end of scorecard -->\n"
HEAD = ("row", "what must hold", "tried", "survived", "lost", "let in", "verdict", "s")


def keep(found: dict[str, Any], results: Path = RESULTS, page: Path = PAGE) -> None:
    """Put the result of a long form in the place of its row's last one, and onto the page."""
    kept = {result["row"]: result for result in read(results)}
    kept[found["row"]] = found | {"of": made_of()}
    ordered = [kept[number] for number in sorted(kept)]
    results.write_text(json.dumps(ordered, indent=1) + "\n")
    before, _, rest = page.read_text().partition(BEGIN)
    after = rest.partition(END)[2]
    page.write_text(before + BEGIN + markdown(ordered) + END + after)


def read(results: Path = RESULTS) -> list[dict[str, Any]]:
    """The results that are kept."""
    return json.loads(results.read_text()) if results.exists() else []


def verdict(found: dict[str, Any]) -> str:
    """One word or three: what was not run is never called passed."""
    if found["lost"] or found["let_in"]:
        return "FAILED"
    if found["passed"]:
        return "passed"
    return "not run" if not found["tried"] else "not all run"


def cells(found: dict[str, Any]) -> tuple[str, ...]:
    """A result as a line of the table."""
    counts = (found[key] for key in ("tried", "survived", "lost", "let_in"))
    numbers = (f"{count:,}" for count in counts)
    return (str(found["row"]), found["title"], *numbers, verdict(found), f"{found['seconds']:.0f}")


def markdown(results: Sequence[dict[str, Any]]) -> str:
    """Results as the part of the page between its two marks."""
    lines = [f"| {' | '.join(HEAD)} |", "|--:|---|--:|--:|--:|--:|---|--:|"]
    found_of = {found["row"]: found for found in results}
    for row in ROWS:
        found = found_of.get(row.number)
        empty = (str(row.number), row.title, "", "", "", "", "not run", "")
        lines += [f"| {' | '.join(cells(found) if found else empty)} |"]
    lines += ["", "What each row measured, and on what:", ""]
    for found in results:
        lines += [f"**{found['row']}. {found['title']}.** {_of(found)}", ""]
        lines += [f"- {name}: {_value(value)}" for name, value in found["figures"].items()]
        lines += [f"- not run: {what}: {why}" for what, why in found["not_run"].items()]
        for key, word in (("lost_first", "lost"), ("let_in_first", "let in")):
            lines += [f"- {word}: `{what}`" for what in found[key]]
        lines += [""]
    return "\n".join(lines)


def print_scorecard(results: Sequence[dict[str, Any]]) -> None:
    """The table on standard output, and what was lost, let in or not run."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="scorecard")
    for name in HEAD:
        table.add_column(name, justify="left" if name in {HEAD[1], "verdict"} else "right")
    for found in results:
        table.add_row(*cells(found))
    console = Console(markup=False)
    console.print(table)
    for found in results:
        for what in [*found["lost_first"], *found["let_in_first"]]:
            print(f"row {found['row']}: {what}")
        for what, why in found["not_run"].items():
            print(f"row {found['row']}: not run: {what}: {why}")
    counts = {word: sum(verdict(found) == word for found in results) for word in VERDICTS}
    print(", ".join(f"{count} {word}" for word, count in counts.items()))


VERDICTS = ("passed", "not all run", "not run", "FAILED")


def made_of() -> dict[str, str]:
    """The tree and the machine that a result is of."""
    from importlib.metadata import version

    commit = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--", ".", f":!{RESULTS.parent.name}/{RESULTS.stem}.*")
    versions = {name: version(name) for name in ("mujoco", "numpy", "numba")}
    return {
        "commit": (commit or "unknown") + (", changed" if changed else ""),
        "python": platform.python_version(),
        **versions,
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def _of(found: dict[str, Any]) -> str:
    of = found.get("of", {})
    return f"Seed {found['seed']}; " + ", ".join(f"{name} {value}" for name, value in of.items())


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
