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
    def file(self) -> Path:
        """Where it stands."""

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
        self._folder = file.absolute().parent
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
            untold = sum(complaint.untold for complaint in complaints)
            texts[MAX_LINES:] = [f"… and {len(texts) - MAX_LINES + untold} more"]
        return "\n".join(texts)

    def home(self, path: KeyPath) -> Path | None:
        """The folder of the file that says what the scenario has at a path; None: an override."""
        causes = [item for item in self.sets if item.covers(path)]
        cause = max(reversed(causes), key=lambda item: len(item.path)) if causes else None
        graft = next((g for g in self._from(cause) if g.place(path)), None)
        if graft is not None:
            return graft.file.absolute().parent
        return None if cause else self._folder

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
        places = (graft.place(path) for graft in self._from(cause))
        return next((place for place in places if place), None)

    def _from(self, cause: Override | None) -> list[Elsewhere]:
        """What `cause` names (None: the file does)."""
        text = cause and cause.text
        return [graft for graft in self._grafts if (graft.cause and graft.cause.text) == text]
