"""Mutations of a source file: one constant, comparison, sign, index or unit conversion changed."""

from __future__ import annotations

import ast
import io
import math
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARISONS = {
    ast.Lt: ("<", ("<=", ">")),
    ast.LtE: ("<=", ("<", ">=")),
    ast.Gt: (">", (">=", "<")),
    ast.GtE: (">=", (">", "<=")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
}
_SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}
_ANGLES = {"radians", "degrees", "deg2rad", "rad2deg"}
# Sums of these concatenate or repeat and have no sign.
_JOINED = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp)
_SMALLEST_UNIT_EXPONENT = 2


@dataclass(frozen=True)
class Mutation:
    """One change of a source.

    Attributes:
        line: line number, from 1.
        start: first replaced character, counted from the beginning of the file.
        end: first character after the replaced ones.
        kind: constant, comparison, sign, index or unit.
        old: replaced text.
        new: new text.
    """

    line: int
    start: int
    end: int
    kind: str
    old: str
    new: str

    def applied(self, source: str) -> str:
        """Return the source with this change."""
        return source[: self.start] + self.new + source[self.end :]


def mutations(source: str) -> list[Mutation]:
    """Return every mutation of a source, in the order of its lines."""
    result = {
        item
        for node, parent in _reached(ast.parse(source), None)
        for item in _Site(source, node, parent).all()
    }
    return sorted(result, key=lambda item: (item.start, item.end, item.new))


def changes_program(mutation: Mutation, source: str) -> bool:
    """Return whether the mutated source is valid Python with another syntax tree."""
    try:
        return ast.dump(ast.parse(mutation.applied(source))) != ast.dump(
            ast.parse(source)
        )
    except SyntaxError:
        return False


def code_lines(source: str) -> int:
    """Count the lines that hold code: no comments, no docstrings, no empty lines."""
    nothing = (
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.STRING,
    )
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return len(
        {token.start[0] for token in tokens if token.type not in nothing}
        - {source.count("\n") + 1}
    )


def _reached(
    node: ast.AST, parent: ast.AST | None
) -> Iterator[tuple[ast.AST, ast.AST | None]]:
    """Yield the executed nodes with their parents: no annotations, strings, or imports for type checkers."""
    if isinstance(node, ast.JoinedStr):  # its positions are unknown before Python 3.12
        return
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
        return
    yield node, parent
    for field, value in ast.iter_fields(node):
        if field not in ("annotation", "returns"):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    yield from _reached(child, node)


class _Site:
    """The mutations of one node of a syntax tree."""

    def __init__(self, source: str, node: ast.AST, parent: ast.AST | None) -> None:
        self._source = source
        self._node = node
        self._parent = parent
        self._lines = source.splitlines(keepends=True)

    def all(self) -> Iterator[Mutation]:
        """Yield the mutations of the node."""
        match self._node:
            case ast.Constant(value=int() | float() as value) if not isinstance(
                value, bool
            ):
                yield from self._number(value)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if (
                type(op) in _COMPARISONS
            ):
                old, others = _COMPARISONS[type(op)]
                for new in others:
                    yield from self._operator(left, right, "comparison", old, new)
            case ast.BinOp(left=left, op=op, right=right) if type(
                op
            ) in _SIGNS and not _joins(left, right):
                yield from self._operator(left, right, "sign", *_SIGNS[type(op)])
            case ast.AugAssign(target=left, op=op, value=right) if type(
                op
            ) in _SIGNS and not _joins(right):
                yield from self._operator(
                    left, right, "sign", *(f"{sign}=" for sign in _SIGNS[type(op)])
                )
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                yield self._replaced(self._node, "sign", self._text(operand))
            case ast.Call(
                func=ast.Name(id=name) | ast.Attribute(attr=name), args=[angle]
            ) if name in _ANGLES:
                yield self._replaced(self._node, "unit", f"({self._text(angle)})")

    def _number(self, value: float) -> Iterator[Mutation]:
        """Yield the mutations of a number: an index, a factor of a unit, or another constant."""
        node = self._node
        parent = self._parent
        if isinstance(parent, ast.Subscript | ast.Slice) and isinstance(value, int):
            for other in {0: (1,), 1: (0, 2)}.get(value, (value - 1, value + 1)):
                yield self._replaced(node, "index", str(other))
        elif (
            isinstance(parent, ast.BinOp)
            and isinstance(parent.op, ast.Mult | ast.Div)
            and _of_unit(value)
        ):
            yield self._replaced(node, "unit", repr(value / 10))
        elif isinstance(value, int):
            yield self._replaced(node, "constant", str(value + 1))
        else:
            for other in (0.9 * value, 2 * value) if value else (1.0,):
                yield self._replaced(node, "constant", repr(other))

    def _operator(
        self, left: ast.AST, right: ast.AST, kind: str, old: str, new: str
    ) -> Iterator[Mutation]:
        """Yield the change of an operator between its operands."""
        after = self._offset(left, "end_")
        before = self._offset(right)
        between = self._source[after:before]
        if between.count(old) == 1 and "#" not in between:
            start = after + between.index(old)
            line = self._source.count("\n", 0, start) + 1
            yield Mutation(line, start, start + len(old), kind, old, new)

    def _replaced(self, node: ast.AST, kind: str, new: str) -> Mutation:
        start = self._offset(node)
        end = self._offset(node, "end_")
        return Mutation(node.lineno, start, end, kind, self._source[start:end], new)

    def _text(self, node: ast.AST) -> str:
        return self._source[self._offset(node) : self._offset(node, "end_")]

    def _offset(self, node: ast.AST, which: str = "") -> int:
        """Return where a node begins or ends, in characters from the beginning of the file."""
        line = getattr(node, f"{which}lineno")
        column = getattr(node, f"{which}col_offset")
        within = self._lines[line - 1].encode()[:column].decode()
        return sum(map(len, self._lines[: line - 1])) + len(within)


def _joins(*operands: ast.AST) -> bool:
    """Return whether one of the operands is a string or a list."""
    return any(isinstance(item, _JOINED) or _is_text(item) for item in operands)


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)


def _of_unit(value: float) -> bool:
    """Return whether a factor is a power of ten of a unit: 100 or 1e-3, but not 10."""
    exponent = math.log10(value) if value > 0 else 0.5
    return exponent == round(exponent) and abs(exponent) >= _SMALLEST_UNIT_EXPONENT
