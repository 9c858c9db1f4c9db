"""One function of Warp's generated C++ for eight worlds at once.

A variable that differs between worlds becomes a `lanes<T>` (`lanes.h`), and a branch on one is taken if any world takes
it. As Warp ends its branches in `wp::where`, only stores, assignments of loops and returns need the mask of the worlds
that take the branch. A function that cannot be translated is called world by world.

The flow of data from the arguments decides which variables differ, as in ISPC. A level says how: `SAME` in all worlds,
`WORLD` the number of the world itself, `LANES` any value for each world; `KEPT` is `model.kept`, 0 in all worlds.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from coopenv.lanes.source import VARIABLE, CannotLaneError, Function, GeneratedSource, folded

SAME, WORLD, LANES, KEPT = "U", "W", "V", "K"
SCALARS = {"int": "wp::int32", "float": "wp::float32", "bool": "bool"}
SCALARS |= {name: f"wp::{name}" for name in ("int32", "uint32", "uint64", "uint8", "float32", "float64")}
_TENSOR = re.compile(r"(wp::(?:vec|mat)_t<[\d, ]+, )(wp::\w+)>$")
_INDEXED = frozenset(("extract", "slice_t", "tuple"))
"""Functions whose operands of type int are no numbers of worlds."""
_ALGEBRA = """
    abs add bit_and bit_or bit_xor ceil clamp copy cross cw_mul diag div dot floor isfinite length length_sq lshift
    mat_t matrix_from_rows max min mul neg normalize outer round rshift sqrt sub trace transpose unot vec_t where
"""
_FUNCTIONS = _INDEXED | {*re.findall(r"\w+", _ALGEBRA)}
"""Functions of Warp that take lanes."""
_OF_TYPE = dict.fromkeys(
    ("acos", "asin", "atan", "atan2", "cos", "exp", "log", "pow", "sign", "sin", "tan"), "wp::float32"
)
_OF_TYPE |= {"floordiv": "wp::int32", "mod": "wp::int32"}
"""Functions of Warp that take lanes of one type alone."""
_INDICES = re.compile(r"coopenv::element\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*?, ([\w, ]+)\)")
EVERY = "for (int l = 0; l < wp::WIDTH; l++)"


class Module(Protocol):
    """The module of a function."""

    source: GeneratedSource
    known: Mapping[str, int]
    """Values of fields of the model, by name, see `folded`."""
    records: dict[str, list[tuple[str, str]]]
    """Kinds and names of the fields of records of numbers alone."""

    def version(self, function: Function, levels: Iterable[str]) -> "Version | None":
        """Return the version of a function for levels of its inputs; None: it is called world by world."""


@dataclass
class Version:
    """One function for levels of its arguments; written again until no level changes."""

    function: Function
    given: tuple[str, ...]
    """Levels of its inputs."""
    module: Module
    levels: dict[str, str] = field(default_factory=dict)
    returns: str = SAME
    outputs: set[str] = field(default_factory=set)  # that are lanes
    pointers: dict[str, str] = field(default_factory=dict)  # templates in `lanes.h`: Place, Places or lanes
    masked_loops: set[str] = field(default_factory=set)
    continued: set[str] = field(default_factory=set)  # loops whose turn some worlds leave early
    changed: bool = True

    def __post_init__(self) -> None:
        """Write all statements."""
        self.levels = dict(zip(self.function.inputs, self.given, strict=True))
        kept = [name for name, level in self.levels.items() if level == KEPT]
        self.statements = folded(self.function, self.module.known, kept)
        while self.changed:
            self.changed, self.early, self.mask = False, False, "m0"
            self.lines, self.masks = list[str](), list[str]()
            self.blocks = list[tuple[str, str, str]]()  # the label of a loop, the mask of the block, and that outside
            for s in self.statements:
                getattr(self, f"_{s.kind}")(*s.parts, s.text)

    # Levels and types.

    def refuse(self, construct: str) -> CannotLaneError:
        """Return the error of a construct in this function."""
        return CannotLaneError(self.function.name, construct)

    def differs(self, text: str) -> bool:
        """Return whether a value that a text mentions differs between worlds."""
        return any(self.levels.get(name, SAME) in (WORLD, LANES) for name in VARIABLE.findall(text))

    def level(self, operand: str) -> str:
        """Return the level of an operand."""
        return self.levels.get(operand, LANES if self.differs(operand) else SAME)

    def _is_lanes(self, name: str, differs: bool) -> bool:
        """Return whether a variable is lanes after a statement that makes it differ."""
        if differs and self.levels.get(name, SAME) == SAME:
            self.levels[name], self.changed = LANES, True
        return self.level(name) == LANES

    def kind(self, name: str) -> str:
        """Return the C++ type of a variable."""
        kind, level = self.function.types[name], self.level(name)
        if level != LANES:
            return "wp::World" if level == WORLD else kind
        if name in self.pointers:
            to, template = kind.replace("__restrict__", "").strip(" *"), self.pointers[name]
            return f"wp::{template}<{to}>" + ("*" if template == "lanes" else "")
        return "wp::Count" if kind == "wp::range_t" else self.laned(kind)

    def laned(self, kind: str) -> str:
        """Return the type of numbers of a type in several worlds."""
        if found := _TENSOR.match(kind):
            return f"{found[1]}wp::lanes<{found[2]}>>"
        if kind not in SCALARS.values() and kind not in self.module.records:
            raise self.refuse(f"values of type {kind}")
        return f"wp::lanes<{kind}>"

    def lanes(self, operand: str) -> str:
        """Return an operand as lanes."""
        return operand if self.level(operand) == LANES else f"wp::spread({operand})"

    def of_lane(self, text: str) -> str:
        """Return a text with the values of world `l`."""
        if any(name in self.pointers for name in VARIABLE.findall(text)):
            raise self.refuse(text)
        return VARIABLE.sub(lambda m: f"wp::lane({m[0]}, l)" if self.differs(m[0]) else m[0], text)

    # Branches, loops and returns.

    @property
    def _masked(self) -> bool:
        """Whether fewer worlds are here than have called the function."""
        return self.early or any(mask for _, mask, _ in self.blocks)

    def _new_mask(self, value: str) -> str:
        self.masks.append(f"m{len(self.masks) + 1}")
        self.lines.append(f"{self.masks[-1]} = {value};")
        return self.masks[-1]

    def _open(self, label: str, mask: str) -> None:
        self.blocks.append((label, mask, self.mask))
        self.mask = mask or self.mask

    def _branch(self, negated: str, condition: str, text: str) -> None:
        mask = ""
        if self.level(condition) == LANES:
            mask = self._new_mask(f"{self.mask} & {'~' * bool(negated)}{condition}")
            text = f"if (wp::any({mask})) {{"
        self.lines.append(text)
        self._open("", mask)

    def _close(self, text: str) -> None:
        self.lines.append(text)
        _, _, self.mask = self.blocks.pop()

    def _loop(self, label: str, text: str) -> None:
        masked = label in self.masked_loops
        live = self._new_mask(self.mask) if masked else ""
        self.lines.append(text)
        self._open(label, live)
        self._open("", self._new_mask(live) if masked else "")

    def _leave(self, label: str, text: str) -> None:
        self._close(text)
        _, _, self.mask = self.blocks.pop()

    def _mask_loop(self, label: str) -> None:
        self.changed |= label not in self.masked_loops
        self.masked_loops.add(label)

    def _end(self, label: str, condition: str, differs: bool, text: str) -> None:
        """End a loop in the worlds where a condition does not hold; the condition is the same in all: as in a text."""
        if differs:
            self._mask_loop(label)
        live = self.blocks[-2][1]
        self.lines += [f"{live} = {live} & {condition};", f"{self.mask} = {live};"] if live and differs else [text]
        if live:
            self.lines.append(f"if (!wp::any({live})) goto end_{label};")

    def _until(self, loop: str, label: str, text: str) -> None:
        self._end(label, f"({loop}.i < {loop}.end)", self.level(loop) == LANES, text)

    def _unless(self, condition: str, label: str, text: str) -> None:
        self._end(label, condition, self.level(condition) == LANES, text)

    def _jump(self, to: str, label: str, text: str) -> None:
        at = [name for name, _, _ in self.blocks].index(label)
        if not any(mask for _, mask, _ in self.blocks[at + 2 :]):
            self.lines.append(text)
            return
        self._mask_loop(label)
        if to == "start":
            self.changed |= label not in self.continued
            self.continued.add(label)
        self._drop(mask for _, mask, _ in self.blocks[at + (to == "start") :])

    def _drop(self, masks: Iterable[str]) -> None:
        """Take the worlds that are here out of masks."""
        rest = " ".join(f"{mask} = {mask} & rest;" for mask in masks if mask)
        self.lines.append(f"{{ const wp::Mask rest = ~{self.mask}; {rest} }}")

    def _result(self, value: str, text: str) -> None:
        if value and (self._masked or self.differs(value)):
            self.changed |= self.returns == SAME
            self.returns = LANES
        if value and self.returns == LANES:
            value = self.lanes(value)
        masks = [mask for _, mask, _ in self.blocks if mask]
        if not self.early and not masks:
            self.lines.append(f"return {value};" if value else text)
            return
        if value:
            self.lines.append(f"wp::assign({self.mask}, result, {value});")
        over = f"return{' result' if value else ''};"
        if masks:
            self.early = True
            for label in [label for label, _, _ in self.blocks if label]:
                self._mask_loop(label)
            self._drop(["m0", *masks])
            over = f"if (!wp::any(m0)) {over}"
        self.lines.append(over)

    # Assignments.

    def _output(self, output: str, value: str, text: str) -> None:
        if self._masked or self.differs(value):
            self.changed |= output not in self.outputs
            self.outputs.add(output)
        self._set(output, self.lanes(value), output in self.outputs, text)

    def _assign(self, target: str, value: str, text: str) -> None:
        masked = self._masked and not self._counts_turns(target)
        self._set(target, self.lanes(value), self._is_lanes(target, masked or self.differs(value)), text)

    def _set(self, target: str, value: str, is_lanes: bool, text: str) -> None:
        """Assign to a variable; in other worlds than the caller's the value is not used."""
        masked = f"wp::assign({self.mask}, {target}, {value});" if self._masked else f"{target} = {value};"
        self.lines.append(masked if is_lanes else text)

    def _counts_turns(self, name: str) -> bool:
        """Return whether an assignment holds for all worlds in the innermost loop, and is not read behind the loop."""
        at = max((n for n, (label, _, _) in enumerate(self.blocks) if label), default=0)
        label = self.blocks[at][0] if self.blocks else ""
        if not label or label in self.continued or any(mask for _, mask, _ in self.blocks[at + 2 :]):
            return False
        ends = [n for n, s in enumerate(self.statements) if s.kind in ("loop", "leave") and s.parts[0] == label]
        others = self.statements[: ends[0]] + self.statements[ends[1] :]
        return not any(name in VARIABLE.findall(s.parts[1] if s.kind == "compute" else s.text) for s in others)

    def _inplace(self, verb: str, template: str, target: str, operands: str, text: str) -> None:
        if not self._is_lanes(target, self._masked or self.differs(operands)):
            self.lines.append(text)
            return
        *indices, last = operands.split(", ")
        value = "value"
        if verb not in ("assign", "add") or (self._masked and len(indices) > 1):
            raise self.refuse(text)
        if self._masked:
            before = f"wp::extract({target}, {indices[0]})" if verb == "assign" else "decltype(value)()"
            value = f"wp::pick({self.mask}, value, {before})"
        call = f"wp::{verb}_inplace{template}({', '.join([target, *indices, value])});"
        self.lines.append(f"{{ auto value = {self.lanes(last)}; {call} }}")

    def _store(self, array: str, indices: str, value: str, text: str) -> None:
        first, *others = indices.split(", ")
        if not self.differs(indices):
            raise self.refuse(text)
        if self.level(first) == WORLD and not any(map(self.differs, others)):
            self.lines.append(f"wp::store({self.mask}, wp::place({array}, {indices}), {self.lanes(value)});")
        else:
            self.lines.append(f"{EVERY} if ({self.mask}.v[l]) {self.of_lane(text)}")

    def _unknown(self, line: str, text: str) -> None:
        raise self.refuse(line)

    def _compute(self, target: str, value: str, text: str) -> None:
        name, dot, _ = target.partition(".")
        if called := self.module.source.call(value, self.function.types):
            self._call(target, *called, value)
        elif value == "builtin_tid1d()":
            self.levels[target] = WORLD
            self.lines.append(f"{target} = world_;")
        elif value.endswith(").kept)") or (value[:8] in ("wp::load", "wp::copy") and self.level(value[9:-1]) == KEPT):
            self.levels[target] = KEPT
            self.lines.append(text)
        elif found := re.match(r"wp::atomic_add\((var_\w+), (.*), (var_\w+)\)$", value):
            element = self.of_lane(f"coopenv::element({found[1]}, {found[2]})")
            before = f"wp::set_lane({target}, l, x); " if self._is_lanes(target, True) else ""
            add = f"auto& x = {element}; {before}x = wp::add(x, {self.of_lane(found[3])});"
            self.lines.append(f"{EVERY} if ({self.mask}.v[l]) {{ {add} }}")
        elif not self._is_lanes(name, self.differs(value) or bool(dot and self._masked)):
            self.lines.append(text)
        elif value.startswith("&"):
            self._address(target, value)
        elif dot:
            self._set(target, self._expression(value), True, text)
        else:
            self.lines.append(f"{target} = {self._expression(value)};")

    def _address(self, target: str, value: str) -> None:
        """Point to a field of lanes, to the same element of each world, or to any elements."""
        rows = [[self.level(name) for name in found.split(", ")] for found in _INDICES.findall(value)]
        if not rows:
            self.pointers[target] = "lanes"
            self.lines.append(f"{target} = {value};")
        elif len(rows) == 1 and rows[0][0] == WORLD and not {WORLD, LANES} & {*rows[0][1:]} and value[1] == "c":
            self.pointers[target] = "Place"
            self.lines.append(f"{target} = {value.replace('&coopenv::element', 'wp::place')};")
        else:
            self.pointers[target] = "Places"
            self.lines.append(f"{EVERY} {target}.p[l] = {self.mask}.v[l] ? {self.of_lane(value)} : nullptr;")

    def _expression(self, text: str) -> str:
        """Return an expression of lanes."""
        found = re.match(r"(wp::)?(\w+)((?:<.*>)?)\((.*)\)$", text)
        if text.startswith("wp::load("):
            return text
        if found and found[2] in ("range", "iter_next"):
            operands = found[4].split(", ")
            if len(operands) > 2:
                raise self.refuse(text)
            return (
                f"wp::next({found[4]})"
                if found[2] == "iter_next"
                else f"wp::count({', '.join(map(self.lanes, operands))})"
            )
        if found:
            return self._function(found[1] or "", found[2], found[3], found[4])
        if VARIABLE.search(text):
            return VARIABLE.sub(lambda m: self.lanes(m[0]), text).replace("&&", "&").replace("||", "|")
        return f"wp::spread({text})"

    def _function(self, space: str, name: str, template: str, inner: str) -> str:
        """Return a call of one of Warp's functions."""
        operands, types = [part for part in inner.split(", ") if part], self.function.types
        if name in self.module.records:
            return f"wp::lanes<{name}>()"
        one = {types.get(operand, "") for operand in operands} == {_OF_TYPE.get(name, "")}
        if not one and name not in _FUNCTIONS and name not in SCALARS:
            raise self.refuse(f"{space}{name}")
        whole = {
            n for n in operands if name in _INDEXED and not self.differs(n) and types[n] in ("wp::int32", "wp::slice_t")
        }
        given = [n if n in whole else self.lanes(n) for n in operands]
        if name == "copy":
            return given[0]
        if name == "where":
            same = self.level(operands[0]) != LANES
            return f"({operands[0]} ? {given[1]} : {given[2]})" if same else f"wp::pick({', '.join(given)})"
        if name in SCALARS:
            return f"wp::lanes<{SCALARS[name]}>({given[0]})"
        if name in ("vec_t", "mat_t"):
            return f"{self.laned(f'wp::{name}{template}')}({', '.join(given)})"
        template = re.sub(r"wp::float\d\d", lambda m: f"wp::lanes<{m[0]}>", template)
        return f"{space}{name}{template}({', '.join(given)})"

    def _call(self, target: str, callee: Function, operands: list[str], text: str) -> None:
        """Call a function of the module."""
        count = len(callee.inputs)
        levels = [self.level(operand) for operand in operands[:count]]
        version = self.module.version(callee, levels) if {WORLD, LANES} & {*levels} else None
        if version is not None:
            for operand, (_, output) in zip(operands[count:], callee.arguments[count:], strict=True):
                self._is_lanes(operand, output in version.outputs)
            is_lanes = bool(target) and self._is_lanes(target, version.returns == LANES)
            text = f"{version.name}({', '.join([self.mask, *operands])})"
            text = f"wp::spread({text})" if is_lanes and version.returns == SAME else text
        elif {WORLD, LANES} & {*levels}:
            if len(operands) > count:
                raise self.refuse(f"outputs of {callee.name}")
            text = f"{callee.name}({', '.join(map(self.of_lane, operands))})"
            if target and self._is_lanes(target, True):
                text = f"wp::set_lane({target}, l, {text})"
            self.lines.append(f"{EVERY} if ({self.mask}.v[l]) {{ {text}; }}")
            return
        elif self.level(target) == LANES:
            text = f"wp::spread({text})"
        self.lines.append(f"{target} = {text};" if target else f"{text};")

    # The whole.

    @property
    def name(self) -> str:
        """Name of the function in C++."""
        overload = self.module.source.functions[self.function.name].index(self.function)
        return f"{self.function.name}_{overload}{''.join(self.given)}"

    def body(self) -> str:
        """Return declarations and statements; the worlds that call are the mask `m0`."""
        arguments = {name for _, name in self.function.arguments}
        declared = [f"wp::Mask {', '.join(self.masks)};"] if self.masks else []
        if self.early and self.return_kind != "void":
            declared.append(f"{self.return_kind} result {{}};")
        for name, kind in self.function.types.items():
            if name in self.function.constants:
                declared.append(f"const {kind} {name} = {self.function.constants[name]};")
            elif name not in arguments:
                declared.append(f"{self.kind(name)} {name};")
        return "".join(f"    {line}\n" for line in [*declared, *self.lines])

    @property
    def return_kind(self) -> str:
        """C++ type that the function returns."""
        return self.laned(self.function.returns) if self.returns == LANES else self.function.returns

    def text(self) -> str:
        """Return the function."""
        arguments = ["wp::Mask m0"]
        for kind, argument in self.function.arguments:
            if argument in self.outputs:
                arguments.append(f"{self.laned(kind.rstrip('& '))}& {argument}")
            else:
                arguments.append(f"{kind if argument.startswith('ret_') else self.kind(argument)} {argument}")
        hint = "WP_NOINLINE " if self.function.name in self.module.source.outlined else ""
        return f"static {hint}{self.return_kind} {self.name}({', '.join(arguments)})\n{{\n{self.body()}}}\n"
