"""Where each complaint stands: on a line of the file, or in a `--set`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dnnmso_mj.loading.complaints import Complaint
from dnnmso_mj.loading.documents import Node, Problem
from dnnmso_mj.loading.overrides import Override
from dnnmso_mj.loading.shape import ABSENT, lookup
from dnnmso_mj.wording import clean

MAX_LINES = 100


class Places:
    """The lines of one scenario file and the overrides of it."""

    def __init__(self, file: Path, root: Node | None, sets: Sequence[Override]) -> None:
        self.name = clean(str(file))
        self.root = root or Node(1, None)
        self.data = self.root.plain()
        self.sets = sets

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
            return (1, self.sets.index(cause)), cause.place
        line = self.root.line_of(path)
        return (0, line), f"{self.name}:{line}"
