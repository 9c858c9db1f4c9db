"""Functions of Warp's generated C++, as statements.

Warp writes straight-line text: all variables are declared first, an operand is a variable, every branch ends in
`wp::where`, and loops are labels with `wp::assign`. So a line is a statement.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field


class CannotLaneError(Exception):
    """A construct that has no translation into lanes, in the function of that name."""

    def __init__(self, function: str, construct: str) -> None:
        super().__init__(f"{function}: {construct}")
        self.function = function


VARIABLE = re.compile(r"\bvar_\w+\b")
_WORD = re.compile(r"\w+")
_FUNCTION = re.compile(
    r"^static (?:WP_NOINLINE )?([^\n(]+?) (\w+)\(\n((?:    [^\n]*\n?)*?)\)\n\{\n(.*?)^\}\n", re.M | re.S
)
_RECORD = re.compile(r"^struct (\w+)\n\{\n((?:    [^\n]+;\n)+)", re.M)
_DECLARATION = re.compile(r"    (const )?(.+?) ?(var_\w+)( = (.*))?;$")
_ARGUMENT = re.compile(r"\s*(.*?)\s*((?:var|ret)_\w+)$", re.M)
_FORWARD = "    //---------\n    // forward\n"
_STATEMENTS = {
    "branch": re.compile(r"if \((!?)(var_\w+)\) \{$"),
    "close": re.compile(r"\}$"),
    "loop": re.compile(r"start_(\w+):;$"),
    "leave": re.compile(r"end_(\w+):;$"),
    "until": re.compile(r"if \((var_\w+)\.i >= \1\.end\) goto end_(\w+);$"),
    "unless": re.compile(r"if \(\((var_\w+)\) == false\) goto end_(\w+);$"),
    "jump": re.compile(r"goto (start|end)_(\w+);$"),
    "result": re.compile(r"return(?: (var_\w+))?;$"),
    "output": re.compile(r"(ret_\d+) = (var_\w+);$"),
    "assign": re.compile(r"wp::assign\((var_\w+), (var_\w+)\);$"),
    "inplace": re.compile(r"wp::(\w+)_inplace(<[^(]*>)?\((var_\w+), (.*)\);$"),
    "store": re.compile(r"coopenv::element\((var_\w+), (.*)\) = (var_\w+);$"),
    "compute": re.compile(r"(?:(var_\w+(?:\.\w+)?) = )?([^=].*);$"),
    "unknown": re.compile(r"(.*)$"),
}
"""Kinds of statements."""


@dataclass(frozen=True)
class Statement:
    """One line: its kind, the parts that its pattern names, and the line itself."""

    kind: str
    parts: tuple[str, ...]
    text: str


def _statement(line: str) -> Statement:
    kind, found = next((kind, found) for kind, pattern in _STATEMENTS.items() if (found := pattern.match(line)))
    return Statement(kind, tuple(part or "" for part in found.groups()), line)


@dataclass(frozen=True)
class Function:
    """A function: its arguments (type, name), the types of all variables, the values of constants, and statements."""

    name: str
    returns: str
    arguments: list[tuple[str, str]]
    types: Mapping[str, str]
    constants: Mapping[str, str]
    statements: list[Statement]

    @property
    def inputs(self) -> list[str]:
        """Names of the arguments that are no outputs."""
        return [name for _, name in self.arguments if not name.startswith("ret_")]

    @property
    def stem(self) -> str:
        """Name of the Python function."""
        return re.sub(r"_\d+$", "", self.name.split("__locals__")[-1])


def parse(name: str, returns: str, arguments: list[tuple[str, str]], body: str) -> Function:
    """Return the function of a body, the text between its braces."""
    head, _, forward = body.partition(_FORWARD)
    declared = [found.groups() for line in head.splitlines() if (found := _DECLARATION.match(line))]
    types = {variable: kind for _, kind, variable, _, _ in declared} | {found: kind for kind, found in arguments}
    constants = {variable: value for constant, _, variable, _, value in declared if constant}
    lines = [line.strip() for line in forward.splitlines()]
    return Function(name, returns, arguments, types, constants, [_statement(n) for n in lines if n and n[:2] != "//"])


@dataclass
class GeneratedSource:
    """The generated C++ of a module: its functions, overloads of a name in a list, and fields of its records."""

    text: str
    functions: dict[str, list[Function]] = field(default_factory=dict)
    records: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    outlined: set[str] = field(default_factory=set)
    """Names of functions that the compiler does not inline."""

    def __post_init__(self) -> None:
        """Read the text."""
        self.outlined.update(re.findall(r"^static WP_NOINLINE [^\n(]+ (\w+)\(", self.text, re.M))
        for returns, name, arguments, body in _FUNCTION.findall(self.text):
            if _FORWARD in body and not name.startswith("adj_") and not name.endswith("_kernel_forward"):
                given = _ARGUMENT.findall(arguments.replace(",\n", "\n"))
                self.functions.setdefault(name, []).append(parse(name, returns, given, body))
        for name, fields in _RECORD.findall(self.text):
            self.records[name] = re.findall(r"(\S.*) (\w+);", fields)

    def call(self, expression: str, types: Mapping[str, str]) -> tuple[Function, list[str]] | None:
        """Return the function that an expression calls, by the types of its operands, and the operands."""
        found = re.match(r"(\w+)\((.*)\)$", expression)
        operands = [part for part in found[2].split(", ") if part] if found else []
        for function in self.functions.get(found[1], []) if found else []:
            kinds = [
                (types.get(name, kind), kind) for name, (kind, _) in zip(operands, function.arguments, strict=False)
            ]
            if len(kinds) == len(operands) and all(_bare(given) == _bare(kind) for given, kind in kinds):
                return function, operands
        return None

    def around(self, stages: Iterable[str]) -> set[str]:
        """Return the names of functions of stages, of all that call them, and of all that the stages call."""
        calls = {name: self._words(found) & set(self.functions) for name, found in self.functions.items()}
        inside = {name for name, found in self.functions.items() if found[0].stem in set(stages)}
        above = set(inside)
        while more := {name for name, called in calls.items() if called & above} - above:
            above |= more
        while more := {callee for name in inside for callee in calls[name]} - inside:
            inside |= more
        return inside | above

    def _words(self, functions: Iterable[Function]) -> set[str]:
        return {word for f in functions for s in f.statements for word in _WORD.findall(s.text)}

    def without_functions(self, head: str, kept: set[str]) -> str:
        """Return a text without the functions that are not kept, and without their derivatives."""
        unused = {name for name in self.functions if name not in kept} | {f"adj_{name}" for name in self.functions}
        return _FUNCTION.sub(lambda m: "" if m[2] in unused else m[0], head)

    def needed(self, texts: Mapping[str, str], rest: str) -> set[str]:
        """Return the names of the functions, in the source and in more texts, that a text needs."""
        names = set(self.functions) | set(texts)
        found = new = set(_WORD.findall(rest)) & names
        while new:
            words = set(_WORD.findall(" ".join(texts.get(name, "") for name in new)))
            words |= self._words(f for name in new for f in self.functions.get(name, []))
            new = (words & names) - found
            found = found | new
        return found


def _bare(kind: str) -> str:
    return re.sub(r"const|__restrict__|[&\s*]", "", kind)


def folded(function: Function, known: Mapping[str, int], given: Iterable[str]) -> list[Statement]:
    """Return the statements of a function without branches that fields of the model exclude.

    If agents are kept by distance (`model.kept` above 0), targets differ between worlds; in a single cell
    (`model.cells.across` is 1) bodies do not.

    Args:
        function: the function.
        known: the values of these fields of the model, by name.
        given: names of the arguments that are `model.kept`.
    """
    changing = {s.parts[0] for s in function.statements if s.kind == "assign"}
    values: dict[str, int | bool] = dict.fromkeys({*given} - changing, known["kept"])
    result, branches, loops = list[Statement](), list[bool | None](), 0
    for s in function.statements:
        loops += (s.kind == "loop") - (s.kind == "leave")
        if s.kind == "branch":
            holds = values.get(s.parts[1])
            branches.append(None if holds is None else bool(holds) != (s.parts[0] == "!"))
        decided = s.kind in ("branch", "close") and branches[-1] is not None
        if False not in branches and not decided:
            result.append(s)
            if s.kind == "compute" and s.parts[0] not in changing:
                _evaluate(function, s, known, values)
            if s.kind == "result" and not loops and None not in branches:
                return result
        if s.kind == "close":
            branches.pop()
    return result


def _evaluate(function: Function, s: Statement, known: Mapping[str, int], values: dict[str, int | bool]) -> None:
    """Note the value of a statement that reads a known field, or compares one with a constant."""
    target, text = s.parts
    values.pop(target, None)
    if (found := re.match(r"&\(.*\.(\w+)\)$", text)) and found[1] in known:
        values[target] = known[found[1]]
    elif (found := re.match(r"(?:wp::(?:load|copy)\()?(var_\w+)\)?$", text)) and found[1] in values:
        values[target] = values[found[1]]
    elif found := re.match(r"\((var_\w+) (==|!=|>) (var_\w+)\)$", text):
        value, constant = values.get(found[1]), function.constants.get(found[3], "")
        if value is not None and constant.isdecimal():
            by = int(constant)
            values[target] = {"==": value == by, "!=": value != by, ">": value > by}[found[2]]
