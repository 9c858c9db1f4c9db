"""Translates modules of Warp's generated C++, whose kernels then take eight worlds at once.

A function that cannot be translated is called world by world.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

from coopenv.lanes.source import CannotLaneError, Function, GeneratedSource, parse
from coopenv.lanes.version import EVERY, SAME, SCALARS, WORLD, Version

HEADER = Path(__file__).with_name("lanes.h")
_FIRST_WORLD = f"""    const wp::World world_ {{ wp::min((int)task_index, (int)dim.size - wp::WIDTH) }};
    wp::Mask m0;
    {EVERY} m0.v[l] = world_.first + l >= (int)task_index ? -1 : 0;
"""
_KERNEL = re.compile(
    r"^static void (?P<name>\w+)_cpu_kernel_forward\(.*?    // argument vars\n(?P<arguments>.*?)"
    r"    //-+\n    // primal vars\n(?P<body>.*?)^\}\n",
    re.M | re.S,
)


@dataclass
class Translation:
    """Versions of the functions of a module for several worlds.

    Functions of a world that are not `chosen` are called world by world, and so are `refused` ones.
    """

    source: GeneratedSource
    chosen: set[str]
    refused: set[str]
    known: Mapping[str, int]
    """Values of fields of the model, by name, see `folded`."""
    versions: dict[tuple[int, tuple[str, ...]], Version] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find the records of numbers alone."""
        found = self.source.records.items()
        self.records = {name: pairs for name, pairs in found if all(kind in SCALARS.values() for kind, _ in pairs)}

    def version(self, function: Function, levels: Iterable[str]) -> Version | None:
        """Return the version of a function for levels of its inputs; None: it is called world by world."""
        given = tuple(levels)
        if function.name in self.refused or (WORLD in given and function.name not in self.chosen):
            return None
        if (id(function), given) not in self.versions:
            self.versions[id(function), given] = Version(function, given, self)
        return self.versions[id(function), given]

    def text(self, kernels: Iterable[re.Match[str]]) -> str:
        """Return the C++ of the module with kernels in lanes."""
        whole, rest = self.source.text, ""
        at = first = whole.index("\nstruct wp_args_")
        for kernel in kernels:
            arguments = re.findall(r"^    (.+?)&? (var_\w+) = _wp_args->", kernel["arguments"], re.M)
            function = parse(kernel["name"], "void", arguments, kernel["body"])
            body = Version(function, (SAME,) * len(function.inputs), self).body()
            step = whole.index("++task_index", kernel.end())
            rest += whole[at : kernel.start("body")] + _FIRST_WORLD + body + whole[kernel.end("body") : step]
            rest, at = f"{rest}task_index += wp::WIDTH", step + len("++task_index")
        rest += whole[at:]
        texts = {version.name: version.text() for version in self.versions.values()}
        needed = self.source.needed(texts, rest)
        records = "".join(_record_text(name, fields) for name, fields in self.records.items())
        lanes = "\n".join(text for name, text in texts.items() if name in needed)
        return self.source.without_functions(whole[:first], needed) + HEADER.read_text() + records + lanes + rest


def _record_text(name: str, fields: list[tuple[str, str]]) -> str:
    """Return the record with lanes for numbers, and access to one world of it."""
    members = " ".join(f"lanes<{kind}> {field};" for kind, field in fields)
    read = " ".join(f"y.{field} = lane(x.{field}, l);" for _, field in fields)
    write = " ".join(f"set_lane(x.{field}, l, y.{field});" for _, field in fields)
    return (
        f"namespace wp {{\nstruct {name}_lanes {{ {members} }};\n"
        f"template <> struct Value<{name}> {{ typedef {name}_lanes lanes; }};\n"
        f"static inline {name} lane(const {name}_lanes& x, int l) {{ {name} y; {read} return y; }}\n"
        f"static inline void set_lane({name}_lanes& x, int l, const {name}& y) {{ {write} }}\n}}\n"
    )


Option = tuple[str, tuple[str, ...], bool, str]


def lanes_option(kernel: str, stages: Iterable[str], grid: bool) -> Option:
    """Return the option of a Warp module with a kernel that takes several worlds at a time, for `in_lanes`.

    Warp compiles a module anew if its options change. So they contain a digest of the header and of the translator.

    Args:
        kernel: name of the kernel; a thread of it takes a world.
        stages: names of the Python functions that are translated, with all that they call; other functions of a world
            are called world by world.
        grid: whether `model.cells.across` may be above 1; `model.kept` is 0.
    """
    files = [*sorted(HEADER.parent.glob("*.py")), HEADER]
    return kernel, tuple(stages), grid, sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def in_lanes(text: str, option: Option) -> str:
    """Return the generated C++ of a module for a `lanes_option`; unchanged if the kernel cannot be translated.

    A step of the loop over threads takes a world. A kernel in lanes takes `WIDTH` worlds per step, and leaves out those
    of the last ones that an earlier step has taken.
    """
    name, stages, grid, _ = option
    source, refused = GeneratedSource(text), set[str]()
    kernels = [found for found in _KERNEL.finditer(text) if found["name"].rpartition("_")[0] == name]
    chosen = source.around(stages)
    known = {"kept": 0} if grid else {"kept": 0, "across": 1}
    while not refused & {kernel["name"] for kernel in kernels}:
        try:
            return Translation(source, chosen, refused, known).text(kernels)
        except CannotLaneError as refusal:
            refused.add(refusal.function)
    return text
