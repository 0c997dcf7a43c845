"""Find the sites of a module, which are the places where it can be mutated, and the replacements for each site.

A mutation replaces the text of one syntax node or operator. The rest of the file and the number of lines stay the same.
Annotations, decorators, type aliases, `__all__`, `__slots__`, `TYPE_CHECKING` blocks, log calls and strings have no
sites, because they have no effect, or an effect on text only.
"""

from __future__ import annotations

import ast
import io
import tokenize
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

COMPARISONS: Final[dict[type[ast.cmpop], tuple[str, ...]]] = {
    ast.Lt: ("<=", ">"),
    ast.LtE: ("<", ">="),
    ast.Gt: (">=", "<"),
    ast.GtE: (">", "<="),
    ast.Eq: ("!=",),
    ast.NotEq: ("==",),
    ast.Is: ("is not",),
    ast.IsNot: ("is",),
    ast.In: ("not in",),
    ast.NotIn: ("in",),
}
ARITHMETIC: Final[dict[type[ast.operator], str]] = {
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "*",
    ast.Mod: "*",
    ast.Pow: "*",
    ast.LShift: ">>",
    ast.RShift: "<<",
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.BitXor: "&",
    ast.MatMult: "*",
}
EXTREMES: Final = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum"}
LOGGERS: Final = ("log", "logger", "logging", "warnings")
NEGATED_BY_OPERATOR: Final = (ast.Eq, ast.NotEq, ast.Is, ast.IsNot, ast.In, ast.NotIn)


@dataclass(frozen=True)
class Mutation:
    """One replacement at one site.

    Module, function, line, mutated line and occurrence identify a mutation, even after other lines of the file changed.
    """

    module: str
    """Path relative to `src/lavt`."""
    function: str
    """Qualified name of the enclosing function or class; empty at module level."""
    line_number: int
    operator: str
    line: str
    """Text of the source line where the replacement begins, without indentation."""
    mutated: str
    """The same line after the replacement."""
    occurrence: int
    """Index of this mutation among the function's mutations with the same `line` and `mutated`."""
    begin: int
    """Offset in the source of the first replaced character."""
    end: int
    """Offset in the source after the last replaced character."""
    replacement: str

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """The fields that identify the mutation."""
        return self.module, self.function, self.line, self.mutated, self.occurrence

    def apply_to(self, source: str) -> str:
        """Return the mutated source of the module."""
        return replace_text(source, self.begin, self.end, self.replacement)


Site = tuple[Mutation, ...]
"""The mutations at one place."""


def replace_text(source: str, begin: int, end: int, text: str) -> str:
    """Replace the source between two offsets by a text; line breaks are added to keep the number of lines."""
    removed_lines = source.count("\n", begin, end) - text.count("\n")
    return source[:begin] + text + "\n" * removed_lines + source[end:]


def find_sites(module: str, source: str) -> list[Site]:
    """Return the sites of a module in the order of its text."""
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    occurrences: Counter[tuple[str, str, str]] = Counter()
    sites = []
    for begin, end, operator, function, replacements in sorted(finder.sites):
        line_number = source.count("\n", 0, begin) + 1
        # Offsets of the whole lines that contain the replaced text: from the first character to the last line break.
        lines_begin, lines_end = source.rfind("\n", 0, begin) + 1, source.find("\n", end)
        line = source[lines_begin:].partition("\n")[0].strip()
        mutations = []
        for text in replacements:
            mutated_lines = replace_text(source[lines_begin:lines_end], begin - lines_begin, end - lines_begin, text)
            mutated = mutated_lines.partition("\n")[0].strip()
            occurrence = occurrences[function, line, mutated]
            occurrences[function, line, mutated] += 1
            mutations.append(
                Mutation(module, function, line_number, operator, line, mutated, occurrence, begin, end, text)
            )
        sites.append(tuple(mutations))
    return sites


class _Finder(ast.NodeVisitor):
    """A visitor that collects the sites of a module."""

    def __init__(self, source: str) -> None:
        self.sites: list[tuple[int, int, str, str, tuple[str, ...]]] = []
        """Begin, end, operator, function and replacements of each site."""
        self._source = source
        self._lines = source.split("\n")
        self._line_offsets = [0]
        for line in self._lines:
            self._line_offsets.append(self._line_offsets[-1] + len(line) + 1)
        self._tokens = [
            (self._line_offsets[token.start[0] - 1] + token.start[1], token.string)
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type in (tokenize.OP, tokenize.NAME) and token.string not in ("(", ")")
        ]
        self._names: list[str] = []
        self._in_function = [False]

    def _add(self, begin: int, end: int, operator: str, *replacements: str) -> None:
        self.sites.append((begin, end, operator, ".".join(self._names), replacements))

    def _offsets(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """Return the offsets of a node in characters; `ast` gives columns in bytes of UTF-8."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self._offset(node.lineno, node.col_offset), self._offset(node.end_lineno, node.end_col_offset)

    def _offset(self, line_number: int, column_bytes: int) -> int:
        """Return the offset in characters of a position that `ast` gives."""
        return self._line_offsets[line_number - 1] + len(self._lines[line_number - 1].encode()[:column_bytes].decode())

    def _between(self, before: ast.expr, after: ast.expr) -> tuple[int, int]:
        """Return the offsets of the operator between two operands."""
        begin, end = self._offsets(before)[1], self._offsets(after)[0]
        tokens = self._tokens[bisect_left(self._tokens, (begin, "")) : bisect_left(self._tokens, (end, ""))]
        (first_offset, _), (last_offset, last_text) = tokens[0], tokens[-1]
        return first_offset, last_offset + len(last_text)

    def _text(self, node: ast.expr | ast.stmt) -> str:
        begin, end = self._offsets(node)
        return self._source[begin:end]

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skip formatted text."""

    def visit_arg(self, node: ast.arg) -> None:
        """Skip the annotation of an argument."""

    def _visit_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self.visit(node.args)
        self._visit_body(node, in_function=True)

    visit_FunctionDef = visit_AsyncFunctionDef = _visit_function  # noqa: N815 (the names that `ast` calls)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        """Visit only the body."""
        self._visit_body(node, in_function=False)

    def _visit_body(self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef, *, in_function: bool) -> None:
        self._names.append(node.name)
        self._in_function.append(in_function)
        for statement in node.body:
            self.visit(statement)
        self._in_function.pop()
        self._names.pop()

    def visit_If(self, node: ast.If) -> None:
        """Negate the condition; skip code for type checkers."""
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            for statement in node.orelse:
                self.visit(statement)
            return
        self._condition(node.test)
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        """Negate the condition."""
        self._condition(node.test)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        """Negate the condition."""
        self._condition(node.test)
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        """Negate the conditions."""
        for test in node.ifs:
            self._condition(test)
        self.generic_visit(node)

    def _condition(self, test: ast.expr) -> None:
        """Add the negation of a condition, unless another operator negates it, too, or it is a constant."""
        negated = isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)
        compared = isinstance(test, ast.Compare) and len(test.ops) == 1 and isinstance(test.ops[0], NEGATED_BY_OPERATOR)
        if not (negated or compared or isinstance(test, ast.Constant)):
            self._add(*self._offsets(test), "not added", f"not ({self._text(test)})")

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        """Remove `not`."""
        if isinstance(node.op, ast.Not):
            begin = self._offsets(node)[0]
            end = begin + len("not")
            spaces = len(self._source[end:]) - len(self._source[end:].lstrip(" "))
            self._add(begin, end + spaces, "not removed", "")
        self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        """Replace each comparison operator by similar ones."""
        for (before, after), operator in zip(pairwise([node.left, *node.comparators]), node.ops, strict=True):
            self._add(*self._between(before, after), "comparison", *COMPARISONS[type(operator)])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        """Replace each `and` by `or`, and each `or` by `and`."""
        for before, after in pairwise(node.values):
            self._add(*self._between(before, after), "and/or", "or" if isinstance(node.op, ast.And) else "and")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        """Replace the operator, unless it joins or formats text."""
        if not (_is_text(node.left) or _is_text(node.right)):
            self._add(*self._between(node.left, node.right), "arithmetic", ARITHMETIC[type(node.op)])
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        """Replace the operator, and remove the statement."""
        if not _is_text(node.value):
            self._add(*self._between(node.target, node.value), "arithmetic", ARITHMETIC[type(node.op)] + "=")
        self._statement(node)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        """Flip a boolean, or change a number; skip text."""
        if isinstance(node.value, bool):
            self._add(*self._offsets(node), "boolean", str(not node.value))
        elif isinstance(node.value, (int, float)):
            other_numbers = dict.fromkeys((node.value + 1, node.value * 2))
            other_numbers.pop(node.value, None)
            in_hex = self._text(node).lower().startswith("0x")
            self._add(
                *self._offsets(node),
                "number",
                *(f"{number:#x}" if in_hex else repr(number) for number in other_numbers),
            )

    def visit_Call(self, node: ast.Call) -> None:
        """Replace `min` by `max` and `max` by `min`; skip log calls and the types of casts."""
        if _is_log_call(node):
            return
        name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
        if name in EXTREMES:
            end = self._offsets(node.func)[1]
            self._add(end - len(name), end, "min/max", EXTREMES[name])
        if name == "cast":
            node.args = node.args[1:]
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        """Remove a call statement, unless it is a log call."""
        if isinstance(node.value, (ast.Call, ast.Await)) and not _is_log_call(node.value):
            self._statement(node)
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        """Remove an assignment in a function; skip type aliases, `__all__` and `__slots__`."""
        target = node.targets[0]
        name = target.id if isinstance(target, ast.Name) else ""
        if not self._in_function[-1] and (name in ("__all__", "__slots__") or _is_type_name(name)):
            return
        self._statement(node)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        """Remove an assignment in a function; skip the annotation."""
        if node.value is not None:
            self._statement(node)
            self.visit(node.value)

    def _statement(self, node: ast.stmt) -> None:
        """Remove a statement of a function. Modules and classes would not work without any of their statements."""
        if self._in_function[-1]:
            self._add(*self._offsets(node), "statement", "pass")

    def visit_Return(self, node: ast.Return) -> None:
        """Replace the returned value by None, unless it is None, or False, which `visit_Constant` flips."""
        if node.value is not None:
            if not (isinstance(node.value, ast.Constant) and (node.value.value is None or node.value.value is False)):
                self._add(*self._offsets(node.value), "return value", "None")
            self.visit(node.value)

    def visit_Break(self, node: ast.Break) -> None:
        """Replace `break` by `continue`."""
        self._add(*self._offsets(node), "break/continue", "continue")

    def visit_Continue(self, node: ast.Continue) -> None:
        """Replace `continue` by `break`."""
        self._add(*self._offsets(node), "break/continue", "break")


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _is_log_call(node: ast.expr) -> bool:
    called = node.func if isinstance(node, ast.Call) else None
    return isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name) and called.value.id in LOGGERS


def _is_type_name(name: str) -> bool:
    bare = name.lstrip("_")
    return bare[:1].isupper() and not bare.isupper()
