"""Mutants of a source file: mutmut's, and a few more that mathematics is prone to.

mutmut makes none in decorated functions, for it puts its copies beside the originals; these here
are put in the place of the original, so that compiled functions and properties have theirs too.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import libcst as cst
from libcst.metadata import CodeRange, MetadataWrapper, WhitespaceInclusivePositionProvider
from mutmut.mutation.file_mutation import Mutation, MutationVisitor
from mutmut.mutation.mutators import mutation_operators
from mutmut.mutation.pragma_handling import IgnoredCode

import dnnmso_mj

PACKAGE = Path(dnnmso_mj.__file__).parent
SWAPPED = {"min": "max", "max": "min", "sin": "cos", "cos": "sin"}


@dataclass(frozen=True)
class Mutant:
    """A source with one thing changed.

    Args:
        file: of the package.
        function: qualified name, empty outside of any.
        line: where it starts.
        before, after: the lines concerned, as one.
        source: of the whole file; the original's where nothing is changed.
    """

    file: str
    function: str
    line: int
    before: str
    after: str
    source: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        """What it is called in the list of explained mutants."""
        return self.file, self.function, self.before, self.after

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.function}: {self.before} -> {self.after}"


def original(file: str) -> Mutant:
    """A mutant that changes nothing."""
    return Mutant(file, "", 0, "", "", (PACKAGE / file).read_text())


@cache
def mutants_of(file: str) -> tuple[Mutant, ...]:
    """Every mutant of a file of the package, in the order of its text."""
    text = (PACKAGE / file).read_text()
    wrapper = MetadataWrapper(cst.parse_module(text))
    found = _Finder((*mutation_operators, *OPERATORS), IgnoredCode(set(), set(), set()))
    wrapper.visit(found)
    places = wrapper.resolve(WhitespaceInclusivePositionProvider)
    functions = list(_functions(ast.parse(text)))
    lines = text.splitlines(keepends=True)
    codes = dict.fromkeys(_changed(wrapper.module, lines, each, places) for each in found.mutations)
    mutants = (_mutant(file, text, code, functions) for code in codes if code != text)
    return tuple(sorted(mutants, key=lambda mutant: mutant.line))


def _changed(
    module: cst.Module,
    lines: list[str],
    mutation: Mutation,
    places: Mapping[cst.CSTNode, CodeRange],
) -> str:
    """The module's text with a mutation; those within a line or expression are put in as text."""
    old, new = mutation.original_node, mutation.mutated_node
    if isinstance(old, cst.BaseCompoundStatement) or old not in places:
        return cst.ensure_type(module.deep_replace(old, new), cst.Module).code
    place = places[old]
    first, last = place.start, place.end
    before = "".join(lines[: first.line - 1]) + lines[first.line - 1][: first.column]
    after = lines[last.line - 1][last.column :] + "".join(lines[last.line :])
    return before + module.code_for_node(new) + after


class _Finder(MutationVisitor):
    """mutmut's, but in decorated functions too."""

    def _skip_node_and_children(self, node: cst.CSTNode) -> bool:
        if isinstance(node, cst.FunctionDef):
            return False
        return isinstance(node, cst.Decorator) or super()._skip_node_and_children(node)


def _swap_name(node: cst.Name) -> Iterator[cst.CSTNode]:
    if node.value in SWAPPED:
        yield node.with_changes(value=SWAPPED[node.value])


def _negate(node: cst.If) -> Iterator[cst.CSTNode]:
    test = node.test.with_changes(lpar=[cst.LeftParen()], rpar=[cst.RightParen()])
    yield node.with_changes(
        test=cst.UnaryOperation(cst.Not(), test),
        whitespace_before_test=cst.SimpleWhitespace(" "),
    )


def _leave_out(node: cst.Expr | cst.AugAssign) -> Iterator[cst.CSTNode]:
    if isinstance(node, cst.AugAssign) or isinstance(node.value, cst.Call):
        yield cst.Pass()


def _leave_out_stored(node: cst.Assign) -> Iterator[cst.CSTNode]:
    if all(isinstance(each.target, cst.Subscript | cst.Attribute) for each in node.targets):
        yield cst.Pass()


OPERATORS = (
    (cst.Name, _swap_name),
    (cst.If, _negate),
    (cst.Expr, _leave_out),
    (cst.AugAssign, _leave_out),
    (cst.Assign, _leave_out_stored),
)


def _functions(tree: ast.AST, above: str = "") -> Iterator[tuple[int, int, str]]:
    """First and last line and qualified name of each class and function, outer ones first."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = f"{above}{node.name}"
            yield node.lineno, node.end_lineno or node.lineno, name
            yield from _functions(node, f"{name}.")


def _mutant(file: str, text: str, code: str, functions: list[tuple[int, int, str]]) -> Mutant:
    old, new = text.splitlines(), code.splitlines()
    start = next(k for k, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1])
    rest = min(len(old), len(new)) - start
    end = next((k for k in range(rest) if old[-1 - k] != new[-1 - k]), rest)
    before, after = (
        " ".join(line.strip() for line in lines[start : len(lines) - end]) for lines in (old, new)
    )
    line = start + 1
    inside = [name for first, last, name in functions if first <= line <= last]
    return Mutant(file, inside[-1] if inside else "", line, before, after, code)
