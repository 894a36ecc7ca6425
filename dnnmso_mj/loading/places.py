"""Where each complaint stands: on a line of the file, or in a `--set`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from dnnmso_mj.loading.complaints import Complaint
from dnnmso_mj.loading.documents import Node, Problem
from dnnmso_mj.loading.overrides import Override
from dnnmso_mj.loading.shape import ABSENT, lookup
from dnnmso_mj.wording import KeyPath, clean

MAX_LINES = 100


class Elsewhere(Protocol):
    """What a scenario takes from another file."""

    @property
    def cause(self) -> Override | None:
        """The override that names it; None: the scenario does."""

    def place(self, path: KeyPath) -> str | None:
        """Where that file has what the scenario has at `path`; None where it has nothing."""


class Places:
    """The lines of one scenario file and the overrides of it.

    Args:
        file, root: the scenario.
        sets: what overrides it.
        grafts: controllers that the file or an override took from elsewhere.
    """

    def __init__(
        self,
        file: Path,
        root: Node | None,
        sets: Sequence[Override],
        grafts: Sequence[Elsewhere] = (),
    ) -> None:
        self.name = clean(str(file))
        self.root = root or Node(1, None)
        self.data = self.root.plain()
        self.sets = sets
        self._grafts = grafts

    def message(self, problems: Sequence[Problem], complaints: Sequence[Complaint]) -> str:
        """All of it, sorted by line; what `--set` brought comes last, in its order."""
        lines = [((0, p.line), f"{self.name}:{p.line}", p.text) for p in problems]
        lines += [(*self.of(complaint), complaint.text) for complaint in complaints]
        lines.sort(key=lambda line: line[0])
        texts = [f"{place}: {text}" for _, place, text in lines]
        if len(texts) > MAX_LINES:
            texts[MAX_LINES:] = [f"… and {len(texts) - MAX_LINES} more"]
        return "\n".join(texts)

    def of(self, complaint: Complaint) -> tuple[tuple[int, int], str]:
        """What to sort a complaint by, and its place in words."""
        path = complaint.path
        causes = [item for item in self.sets if item.covers(path)]
        if not causes and complaint.missing:
            causes = [item for item in self.sets if item.covers((*path[:-1], "kind"))]
        if not causes and lookup(self.data, path) is ABSENT:
            causes = [item for item in self.sets if item.enters(path)]
        if causes:
            cause = max(reversed(causes), key=lambda item: len(item.path))
            return (1, self.sets.index(cause)), self._elsewhere(path, cause) or cause.place
        line = self.root.line_of(path)
        return (0, line), self._elsewhere(path, None) or f"{self.name}:{line}"

    def _elsewhere(self, path: KeyPath, cause: Override | None) -> str | None:
        """Where what `cause` (None: the file) has at `path` was taken from, if it was."""
        text = cause and cause.text
        places = (g.place(path) for g in self._grafts if (g.cause and g.cause.text) == text)
        return next((place for place in places if place), None)
