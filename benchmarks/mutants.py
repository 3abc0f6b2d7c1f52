"""Mutants of a module: places where one operator, constant, sign, bound or statement changes."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import difflib
from itertools import islice
from pathlib import Path
import random
import re

_ARITHMETIC: dict[type, tuple[str, str]] = {
    ast.Add: ('+', '-'), ast.Sub: ('-', '+'), ast.Mult: ('*', '/'), ast.Div: ('/', '*'),
    ast.FloorDiv: ('//', '*'), ast.Mod: ('%', '*'), ast.Pow: ('**', '*'), ast.MatMult: ('@', '*')}
# Each comparison with its boundary moved first, then the other way round.
_COMPARISON: dict[type, tuple[str, tuple[str, ...]]] = {
    ast.Lt: ('<', ('<=', '>')), ast.LtE: ('<=', ('<', '>')), ast.Gt: ('>', ('>=', '<')),
    ast.GtE: ('>=', ('>', '<')), ast.Eq: ('==', ('!=',)), ast.NotEq: ('!=', ('==',)),
    ast.Is: ('is', ('is not',)), ast.IsNot: ('is not', ('is',)),
    ast.In: ('in', ('not in',)), ast.NotIn: ('not in', ('in',))}


@dataclass(frozen=True)
class Mutant:
    """
    One change of one module.

    Attributes
    ----------
    path : str
        Of the module, below the root of the project.
    line : int
        Of the change.
    kind : str
        What was changed: 'operator', 'comparison', 'constant', ...
    first, last : int
        Lines of the statement (of its head, if it has a body) that holds the change.
    begin, end : int
        Bytes of the source that are replaced.
    text : str
        What replaces them.

    """

    path: str
    line: int
    kind: str
    first: int
    last: int
    begin: int
    end: int
    text: str

    @property
    def key(self) -> str:
        """Return a name that is the same in every run over the same source."""
        return f'{self.path}:{self.line}:{self.begin}:{self.kind}:{self.text}'

    def apply(self, source: bytes) -> bytes:
        """Return the source with the change in it."""
        return source[:self.begin] + self.text.encode() + source[self.end:]

    def diff(self, source: bytes) -> str:
        """Return the change as a unified diff of no context."""
        before, after = (text.decode().splitlines() for text in (source, self.apply(source)))
        lines = list(difflib.unified_diff(before, after, self.path, self.path, '', '', n=0,
                                          lineterm=''))
        return '\n'.join(lines[2:])


class _Finder:
    """Walks a module and collects its mutants."""

    def __init__(self, path: str, source: bytes) -> None:
        self.path, self.source = path, source
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.found: list[Mutant] = []
        self.statement: ast.stmt | None = None

    def at(self, line: int, column: int) -> int:
        """Return the byte at a line and a column of the syntax tree."""
        return self.starts[line - 1] + column

    def span(self, node: ast.AST) -> tuple[int, int]:
        """Return first byte and end of a node."""
        return (self.at(node.lineno, node.col_offset),  # type: ignore[attr-defined]
                self.at(node.end_lineno, node.end_col_offset))  # type: ignore[attr-defined]

    def add(self, kind: str, begin: int, end: int, text: str) -> None:
        """Keep a mutant."""
        held = self.statement
        assert held is not None
        body = getattr(held, 'body', None)
        last = body[0].lineno - 1 if body else held.end_lineno or held.lineno
        line = self.source[:begin].count(b'\n') + 1
        self.found.append(Mutant(self.path, line, kind, held.lineno, max(last, held.lineno),
                                 begin, end, text))

    def swap(self, kind: str, left: ast.AST, right: ast.AST, old: str,
             new: Iterable[str]) -> None:
        """Replace the operator that stands between two nodes."""
        begin, end = self.span(left)[1], self.span(right)[0]
        words = r'\s+'.join(re.escape(word) for word in old.split())
        hit = re.search(words.encode(), self.source[begin:end])
        if hit:
            for text in new:
                self.add(kind, begin + hit.start(), begin + hit.end(), text)

    def expression(self, node: ast.AST) -> None:
        """Collect the mutants of one node that is no statement."""
        begin, end = self.span(node) if hasattr(node, 'lineno') else (0, 0)
        if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            if not any(map(_is_text, (node.left, node.right))):
                old, new = _ARITHMETIC[type(node.op)]
                self.swap('operator', node.left, node.right, old, [new])
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            for k, kind in enumerate(node.ops):
                old, others = _COMPARISON[type(kind)]
                self.swap('comparison', sides[k], sides[k + 1], old, others)
        elif isinstance(node, ast.BoolOp):
            pair = ('and', 'or') if isinstance(node.op, ast.And) else ('or', 'and')
            for left, right in zip(node.values, node.values[1:]):
                self.swap('logic', left, right, pair[0], [pair[1]])
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Not)):
            kind = 'sign' if isinstance(node.op, ast.USub) else 'logic'
            self.add(kind, begin, end, self.text(node.operand))
        elif isinstance(node, ast.IfExp):
            self.add('condition', *self.span(node.test), f'not {self.text(node.test)}')
        elif isinstance(node, ast.Constant):
            for text in _other_values(node.value):
                self.add('constant', begin, end, text)

    def text(self, node: ast.AST) -> str:
        """Return the source of a node."""
        begin, end = self.span(node)
        return f'({self.source[begin:end].decode()})'

    def visit(self, node: ast.AST) -> None:
        """Walk a node: statements, what they calculate, their bodies."""
        if isinstance(node, (ast.JoinedStr, ast.Import, ast.ImportFrom)):
            # Columns within f-strings are wrong before Python 3.12; words are no mutants.
            return
        if isinstance(node, ast.stmt):
            if _is_docstring(node) or _is_for_types(node):
                return
            before, self.statement = self.statement, node
            self.removed(node)
            self.children(node)
            self.statement = before
            return
        self.expression(node)
        self.children(node)

    def children(self, node: ast.AST) -> None:
        """Visit all parts of a node but annotations and decorators."""
        for name, value in ast.iter_fields(node):
            if name in ('annotation', 'returns', 'decorator_list'):
                continue
            for part in value if isinstance(value, list) else [value]:
                if isinstance(part, ast.AST):
                    self.visit(part)

    def removed(self, node: ast.stmt) -> None:
        """Collect what concerns a statement as a whole."""
        begin, end = self.span(node)
        stores = (ast.Attribute, ast.Subscript)
        if isinstance(node, (ast.Expr, ast.AugAssign, ast.Raise, ast.Continue, ast.Break)) or (
                isinstance(node, ast.Assign) and isinstance(node.targets[0], stores)):
            self.add('removed', begin, end, 'pass')
        if isinstance(node, ast.AugAssign) and type(node.op) in _ARITHMETIC:
            old, new = _ARITHMETIC[type(node.op)]
            self.swap('operator', node.target, node.value, old + '=', [new + '='])
        if isinstance(node, ast.If):
            self.add('condition', *self.span(node.test), f'not {self.text(node.test)}')


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, (str, bytes)))


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and _is_text(node.value)


def _is_for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and 'TYPE_CHECKING' in ast.dump(node.test)


def _other_values(value: object) -> Iterator[str]:
    if isinstance(value, bool):
        yield str(not value)
    elif isinstance(value, (int, float)):
        yield from dict.fromkeys(
            repr(other) for other in (value * 2, value + 1, value - 1) if other != value)


def mutants(path: str, source: bytes) -> list[Mutant]:
    """Return all mutants of a module, in the order of its source."""
    finder = _Finder(path, source)
    finder.visit(ast.parse(source))
    return sorted(finder.found, key=lambda one: (one.begin, one.end, one.text))


def draw(root: Path, folders: Iterable[str], seed: int, number: int) -> list[Mutant]:
    """
    Return mutants of the folders, in random order, one of each place at most.

    So a comparison, which has three other forms, comes no more often than a removed statement;
    the first n of many are a random sample of n.
    """
    rng = random.Random(seed)
    places: dict[tuple[str, int, int, str], list[Mutant]] = {}
    sources: dict[str, bytes] = {}
    for folder in folders:
        base = root / folder
        for path in sorted(base.rglob('*.py')) if base.is_dir() else [base]:
            name = path.relative_to(root).as_posix()
            sources[name] = path.read_bytes()
            for one in mutants(name, sources[name]):
                places.setdefault((name, one.begin, one.end, one.kind), []).append(one)
    chosen = [rng.choice(forms) for forms in places.values()]
    rng.shuffle(chosen)
    return list(islice((one for one in chosen if _is_python(one.apply(sources[one.path]))),
                       number))


def _is_python(source: bytes) -> bool:
    try:
        compile(source, '', 'exec')
    except (SyntaxError, ValueError):
        return False
    return True


def names_set(source: bytes, mutant: Mutant) -> set[str]:
    """Return the names that a statement outside any function sets; none within functions."""
    for node in ast.parse(source).body:
        if node.lineno <= mutant.line <= (node.end_lineno or node.lineno):
            targets = node.targets if isinstance(node, ast.Assign) else [
                node.target] if isinstance(node, (ast.AnnAssign, ast.AugAssign)) else []
            return {part.id for target in targets for part in ast.walk(target)
                    if isinstance(part, ast.Name)}
    return set()


def function_lines(source: bytes) -> list[tuple[int, int, int]]:
    """Return line of the head, first and last line of the body of each function."""
    return [(node.lineno, node.body[0].lineno, node.end_lineno or node.lineno)
            for node in ast.walk(ast.parse(source))
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def function_at(source: bytes, mutant: Mutant) -> tuple[str, int]:
    """Return qualified name and first line of the outermost function with a mutant in its body."""
    def within(node: ast.AST, prefix: str) -> tuple[str, int]:
        for part in ast.iter_child_nodes(node):
            if not getattr(part, 'lineno', mutant.line) <= mutant.line <= getattr(
                    part, 'end_lineno', mutant.line):
                continue
            if isinstance(part, ast.ClassDef):
                return within(part, f'{prefix}{part.name}.')
            if isinstance(part, (ast.FunctionDef, ast.AsyncFunctionDef)) and (
                    part.body[0].lineno <= mutant.line):
                return prefix + part.name, min(
                    [part.lineno, *(one.lineno for one in part.decorator_list)])
        return '', 0
    return within(ast.parse(source), '')


def lines_that_use(source: bytes, names: set[str]) -> set[int]:
    """Return the lines on which names are read."""
    return {node.lineno for node in ast.walk(ast.parse(source))
            if isinstance(node, ast.Name) and node.id in names
            and isinstance(node.ctx, ast.Load)}
