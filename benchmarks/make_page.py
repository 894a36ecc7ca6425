"""Write the numbers and the picture of docs/performance.md anew.

    python benchmarks/make_page.py                    # runs `dnnmso bench`, about three minutes
    python benchmarks/make_page.py --keep             # from benchmarks/results.json as it stands
    dnnmso bench --json > benchmarks/results.json     # or from a run made by hand

The page keeps its own words; what stands between its two markers is replaced.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, StrMethodFormatter

from dnnmso_mj.bench.run import run_bench
from dnnmso_mj.figures.drawing import COLOURS, house_style

HERE = Path(__file__).parent
RESULTS = HERE / "results.json"
PAGE = HERE.parent / "docs" / "performance.md"
PICTURE = HERE.parent / "docs" / "images" / "growth.png"
BEGIN, END = "<!-- numbers begin: benchmarks/make_page.py -->", "<!-- numbers end -->"

COLUMNS = {
    "median": "median", "rounds": "rounds", "p99": "p99", "p999": "p99.9", "max": "max",
    "ratio": "times slower", "bounded_by": "bounded by",
}  # fmt: skip
SPREAD = ("median", "low", "high")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--keep", action="store_true", help="do not run the benchmark again")
    if not parser.parse_args().keep:
        document = run_bench().document()
        RESULTS.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    document = json.loads(RESULTS.read_text(encoding="utf-8"))
    if document["status"] != "ok":
        raise SystemExit("contenders that do not compute the same: see the checks")
    draw(document, PICTURE)
    PAGE.write_text(with_numbers(PAGE.read_text(encoding="utf-8"), document), encoding="utf-8")
    for path in (RESULTS, PICTURE, PAGE):
        print(path)


def with_numbers(page: str, document: dict[str, Any]) -> str:
    """The page with the document's numbers between its markers."""
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n\n{numbers(document)}\n{END}{after}"


def numbers(document: dict[str, Any]) -> str:
    """All tables of a benchmark as Markdown, and what they were made with."""
    parts = [_provenance(document)]
    for table in document["tables"]:
        parts += [f"### {table['title']}", f"{_capital(table['work'])}. Unit: {table['unit']}."]
        parts.append(_curves(table) if table["axis"] else _rows(table))
        if table["checks"]:
            parts.append(_checks(table["checks"]))
        if table["details"]:
            lines = [f"- {name}: {_number(value)}" for name, value in table["details"].items()]
            parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def _provenance(document: dict[str, Any]) -> str:
    machine, load = document["machine"], document["load_before"]
    versions = ", ".join(f"{name} {value}" for name, value in document["versions"].items())
    quick = "**Tried out with `--quick`: not numbers to quote.** " if document["quick"] else ""
    return (
        f"{quick}{document['date']}, commit {document['git_commit'] or 'unknown'}, on "
        f"{machine['cpu']} with {machine['cores']} cores and {machine['ram_gib']} GiB; "
        f"load average before: {load}; {versions}. All of it in one run of "
        f"{document['wall_s']:.0f} s."
    )


def _rows(table: dict[str, Any]) -> str:
    rows = [row | {"rounds": _rounds(row)} for row in table["rows"]]
    used = [key for key in COLUMNS if any(row[key] not in (None, "") for row in rows)]
    lines = ["| | " + " | ".join(COLUMNS[key] for key in used) + " |"]
    lines.append("| --- |" + " --- |" * len(used))
    for row in rows:
        cells = [row["missing"]] if row["missing"] else [_number(row[key]) for key in used]
        lines.append(f"| {row['name']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _curves(table: dict[str, Any]) -> str:
    """One line for each point of the axis, one column for each curve."""
    points: dict[float, dict[str, float]] = {row["at"]: {} for row in table["rows"]}
    for row in table["rows"]:
        points[row["at"]][row["curve"]] = row["median"]
    curves = list(dict.fromkeys(row["curve"] for row in table["rows"]))
    lines = [f"| {table['axis']} | " + " | ".join(curves) + " |"]
    lines.append("| --- |" + " --- |" * len(curves))
    for at, medians in points.items():
        cells = (_number(medians.get(curve)) for curve in curves)
        lines.append(f"| {_number(at)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _checks(checks: list[dict[str, Any]]) -> str:
    found = "; ".join(f"{check['what']} {check['error']:.1e}" for check in checks)
    return f"The same was computed; differences: {found}."


def _rounds(row: dict[str, Any]) -> str:
    return "" if row["low"] is None else f"{_number(row['low'])} to {_number(row['high'])}"


def _number(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else "" if value is None else str(value)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def draw(document: dict[str, Any], path: Path) -> None:
    """How costs grow, each table with an axis a panel; shaded: from round to round."""
    tables = [table for table in document["tables"] if table["axis"]]
    with house_style():
        figure = Figure(figsize=(9.0, 5.6), layout="constrained")
        axes = figure.subplots(-(-len(tables) // 2), 2, squeeze=False).ravel()
        for table, ax in zip(tables, axes, strict=False):
            _panel(ax, table)
        figure.savefig(path)


def _panel(ax: Axes, table: dict[str, Any]) -> None:
    curves = dict.fromkeys(row["curve"] for row in table["rows"] if row["median"])
    for curve, colour in zip(curves, COLOURS, strict=False):
        rows = [row for row in table["rows"] if row["curve"] == curve]
        at, median, low, high = ([row[key] for row in rows] for key in ("at", *SPREAD))
        ax.plot(at, median, color=colour, marker="o", markersize=3, label=curve)
        ax.fill_between(at, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.set(title=table["title"], xlabel=table["axis"], ylabel=table["unit"])
    ax.set(xscale="log", yscale="log")
    ticks = sorted({row["at"] for row in table["rows"]})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.minorticks_off()
    ax.legend()


if __name__ == "__main__":
    main()
