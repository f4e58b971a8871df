"""Random faults: comparisons, arithmetic, constants, conditions and removed statements."""

from __future__ import annotations

import ast
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass

_COMPARE: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.GtE),
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.LtE),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}


@dataclass(frozen=True)
class Change:
    """Characters `begin` to `end` become `new`."""

    kind: str
    begin: int
    end: int
    new: str


def changes(name: str, text: str) -> list[Change]:
    """Return every change that the operators can make to a file."""
    found = _c_changes(text) if name.endswith((".c", ".h")) else _python_changes(text)
    return sorted(found, key=lambda change: (change.begin, change.end, change.new))


def drawn(
    files: dict[str, str], count: int, seed: int, lines: re.Pattern[str]
) -> list[tuple[str, Change]]:
    """Draw changes without repetition, of lines that hold a pattern, each as likely as the next."""
    every = [
        (name, change)
        for name, text in files.items()
        for change in changes(name, text)
        if lines.search(_line(text, change.begin))
    ]
    random.Random(seed).shuffle(every)
    return every[:count]


def _line(text: str, place: int) -> str:
    end = text.find("\n", place)
    return text[text.rfind("\n", 0, place) + 1 : end if end >= 0 else None]


# ---------------------------------------------------------------- Python


def _python_changes(text: str) -> Iterator[Change]:
    tree = ast.parse(text)
    starts = [0]
    for line in text.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    raw = text.encode()

    def place(node: ast.AST) -> tuple[int, int]:
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        return len(raw[:begin].decode()), len(raw[:end].decode())

    for node in _code(tree):
        for kind, new in _python_variants(node):
            yield Change(kind, *place(node), new)


def _code(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that are run: no annotations, messages, imports, or type checking."""
    if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr | ast.Assert):
        return
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    yield node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _code(child)


def _python_variants(node: ast.AST) -> Iterator[tuple[str, str]]:
    match node:
        case ast.Compare(ops=[op]) if type(op) in _COMPARE:
            for other in _COMPARE[type(op)]:
                new = ast.Compare(node.left, [other()], node.comparators)
                yield "comparison", f"({ast.unparse(new)})"
        case ast.BinOp(op=op) if type(op) in _ARITHMETIC and not _text(node):
            new = ast.BinOp(node.left, _ARITHMETIC[type(op)](), node.right)
            yield "arithmetic", f"({ast.unparse(new)})"
        case ast.AugAssign(op=op) if type(op) in _ARITHMETIC:
            new = ast.AugAssign(node.target, _ARITHMETIC[type(op)](), node.value)
            yield "arithmetic", ast.unparse(new)
            yield "removed statement", "pass"
        case ast.UnaryOp(op=ast.USub()) if not isinstance(node.operand, ast.Constant):
            yield "arithmetic", f"({ast.unparse(node.operand)})"
        case ast.UnaryOp(op=ast.Not()):
            yield "condition", f"bool({ast.unparse(node.operand)})"
        case ast.BoolOp(op=op):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield "condition", f"({ast.unparse(ast.BoolOp(other, node.values))})"
        case ast.IfExp():
            yield "condition", f"({ast.unparse(ast.IfExp(node.test, node.orelse, node.body))})"
        case ast.Constant(value=bool(value)):
            yield "constant", repr(not value)
        case ast.Constant(value=int(value)):
            yield "constant", repr(value + 1)
        case ast.Constant(value=float(value)):
            yield "constant", repr(2.0 * value if value else 1.0)
        case ast.Expr(value=ast.Call()):
            yield "removed statement", "pass"
        case ast.Assign(targets=[ast.Subscript() | ast.Attribute()]):
            yield "removed statement", "pass"


def _text(node: ast.BinOp) -> bool:
    """Return whether an operation puts text or types together."""
    parts = (node.left, node.right)
    return any(
        isinstance(p, ast.JoinedStr)
        or (isinstance(p, ast.Constant) and (p.value is None or isinstance(p.value, str)))
        for p in parts
    ) or (isinstance(node.op, ast.BitOr) and all(isinstance(p, ast.Name) for p in parts))


# ---------------------------------------------------------------- C

_C = {
    r" < ": (" <= ", " > "),
    r" <= ": (" < ", " >= "),
    r" > ": (" >= ", " < "),
    r" >= ": (" > ", " <= "),
    r" == ": (" != ",),
    r" != ": (" == ",),
    r" \+ ": (" - ",),
    r" - ": (" + ",),
    r" \* ": (" / ",),
    r" / ": (" * ",),
    r" \+= ": (" -= ",),
    r" -= ": (" += ",),
    r" \*= ": (" /= ",),
    r" && ": (" || ",),
    r" \|\| ": (" && ",),
}
#: A statement that stores into something declared before, or a call alone on its line.
_STATEMENT = (
    r"(?m)^ +(?!return|const|double|int|ptrdiff_t|static|break|continue|goto|case)"
    r"(?:[\w\[\]>.*()+ -]+ [-+*/]?= .*;|\w+\(.*\);)$"
)
_KINDS = {"<": "comparison", ">": "comparison", "=": "comparison", "!": "comparison"}


def _c_changes(text: str) -> Iterator[Change]:
    code = _blanked(text)
    for pattern, replacements in _C.items():
        for match in re.finditer(pattern, code):
            sign = match[0].strip()
            kind = "condition" if sign in ("&&", "||") else _KINDS.get(sign[0], "arithmetic")
            for new in replacements:
                yield Change(kind, match.start(), match.end(), new)
    for match in re.finditer(r"(?<![\w.])(\d+\.\d+(?:e-?\d+)?|\d+)(?![\w.])", code):
        number = match[0]
        new = repr(2.0 * float(number) or 1.0) if "." in number else str(int(number) + 1)
        yield Change("constant", *match.span(), new)
    for match in re.finditer(r"\bif \((.*)\)(?= *\{?\n)", code):
        new = f"if (!({text[match.start(1) : match.end(1)]}))"
        yield Change("condition", match.start(), match.end(), new)
    for match in re.finditer(_STATEMENT, code):
        begin = match.start() + len(match[0]) - len(match[0].lstrip())
        yield Change("removed statement", begin, match.end(), ";")


def _blanked(text: str) -> str:
    """Return C with blanks for comments, strings and directives."""
    pattern = r'/\*.*?\*/|"(?:\\.|[^"\\])*"|^[ \t]*#(?:\\\n|[^\n])*$'
    return re.sub(pattern, lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=re.S | re.M)
