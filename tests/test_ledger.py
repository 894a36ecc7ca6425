"""The ledger: every variant runs, and page and script name the same groups."""

from __future__ import annotations

import importlib.util
import math
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.simulation import simulate

DOCS = Path(__file__).parents[1] / "docs"
SCRIPT, PAGE = DOCS / "ledger.py", DOCS / "reproduction.md"


def load_ledger() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ledger", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["ledger"] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


ledger = load_ledger()
GROUPS = ledger.load_groups()
VARIANTS = sorted({text for group in GROUPS.values() for text in group.variants.values()} - {""})


@pytest.mark.parametrize("overrides", VARIANTS)
def test_every_variant_is_a_scenario_that_differs_from_the_shipped_one(overrides):
    changed = ledger.scenario_of(overrides, 0)
    assert changed != ledger.scenario_of("", 0)
    assert changed.n_ticks * changed.dt >= 10.0


@pytest.mark.parametrize("name", GROUPS)
def test_every_group_compares_different_variants_with_the_shipped_one(name):
    group = GROUPS[name]
    assert "" in group.variants.values()
    assert len(set(group.variants.values())) == len(group.variants) > 1
    assert set(group.columns) <= set(ledger.HEADINGS)


def test_a_variant_is_measured_and_makes_a_row_of_its_table():
    texts = "duration=0.05 controller.network.hidden=[5]"
    group = ledger.Group("Tiny", {"small": texts})
    tasks = ledger.tasks_of(texts, 3)
    assert tasks == [(texts, 0), (texts, 1), (texts, 2)]
    table = ledger.section("tiny", group, 3, {task: ledger.measure(task) for task in tasks})
    row = table.splitlines()[-1]
    assert "| `--set duration=0.05 --set 'controller.network.hidden=[5]'` |" in row
    errors = [compute_metrics(simulate(ledger.scenario_of(texts, seed))) for seed in range(3)]
    low, median, high = np.sort([metrics["rmse_steady"] for metrics in errors])
    assert f"| {median:.3g} [{low:.3g}, {high:.3g}] |" in row
    assert row.endswith("| 0 of 3 |")


def test_a_diverged_run_counts_as_infinitely_bad_and_is_never_left_out():
    runs = [{"rmse_steady": value, "diverged": 0.0} for value in (1e-3, 3e-3)]
    runs.append({"rmse_steady": math.inf, "diverged": 1.0})
    group = ledger.Group("Some diverge", {"a": "seed=1"}, ("rmse_steady", "tau_peak"))
    results = {("seed=1", seed): run for seed, run in enumerate(runs)}
    row = ledger.section("some", group, 3, results).splitlines()[-1]
    assert row == "| a | `--set seed=1` | 0.003 [0.001, ∞] | none | 1 of 3 |"


def test_a_run_that_diverges_is_measured_as_such():
    found = ledger.measure(("controller.observer.feedback=as_printed duration=1.0", 0))
    assert found["diverged"] == 1.0
    assert found["rmse_steady"] == found["tau_peak"] == math.inf
    assert 0.1 < found["end"] < 1.0


def test_one_run_is_enough_where_nothing_is_drawn():
    assert ledger.tasks_of("controller.kind=no_network", 10) == [("controller.kind=no_network", 0)]


def test_the_first_update_is_eta_by_sign_and_bolder_by_one_over_the_root_of_one_minus_beta():
    short = "duration=0.05"
    by_sign = ledger.measure((f"{short} controller.madam.beta=0.0", 0))
    as_printed = ledger.measure((short, 0))
    assert by_sign["update_first"] == pytest.approx(1e-3, rel=2e-3)
    assert as_printed["update_first"] == pytest.approx(1e-3 / math.sqrt(1 - 0.999), rel=2e-2)


def test_without_learning_the_last_weights_know_what_the_live_ones_knew():
    found = ledger.measure(("duration=0.2 controller.madam.eta=1e-12", 0))
    assert found["recall_half"] == pytest.approx(found["f_err_rms_steady"], rel=1e-6)
    learning = ledger.measure(("duration=0.2", 0))
    assert learning["recall_half"] != pytest.approx(learning["f_err_rms_steady"], rel=0.1)


def test_the_papers_bound_breaks_without_slack_coupling_and_ours_does_not():
    overrides = "duration=2.0 controller.kind=no_network controller.inversion.lam=0.0"
    found = ledger.measure((overrides, 0))
    assert found["paper_bound_broken"] > 50
    assert found["paper_ultimate"] > 1
    assert found["bound_broken"] == 0


def test_an_unknown_group_is_one_message_and_exit_status_two():
    done = subprocess.run(
        [sys.executable, SCRIPT, "nonsense"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "GROUP = nonsense: unknown; allowed: headline" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


# The page


def page_sections() -> dict[str, str]:
    parts = re.split(r"^### `([\w-]+)`", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_page_and_script_have_the_same_groups_in_the_same_order():
    assert list(page_sections()) == list(GROUPS)


def test_every_command_on_the_page_names_groups_that_exist():
    commands = re.findall(r"python docs/ledger\.py([^`\n]*)", PAGE.read_text(encoding="utf-8"))
    named = {word for text in commands for word in re.findall(r"(?<![\w-])[a-z][\w-]*", text)}
    assert named == set(GROUPS)


@pytest.mark.parametrize("name", GROUPS)
def test_every_table_on_the_page_has_the_variants_and_columns_of_its_group(name):
    group, seeds = GROUPS[name], 100 if name == "headline" else 10
    empty = {
        (text, seed): {"diverged": 0.0} for text in group.variants.values() for seed in range(seeds)
    }
    expected = ledger.section(name, group, seeds, empty).splitlines()
    found = [line for line in page_sections()[name].splitlines() if line]
    assert expected[2] in found, "the command"
    assert expected[4] in found, "the head of the table"
    names = [line.split(" | ")[:2] for line in expected[6:]]
    rows = [line.split(" | ")[:2] for line in found if line.startswith("| ")][1:]
    assert [row for row in rows if row in names] == names
