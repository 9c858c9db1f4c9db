"""TOML files from outside in typed sections, checked, each with an error of one line; the types of their quantities."""

import ast
import inspect
import math
import re
import tomllib
from collections.abc import Callable
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, reduce
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import SchemaValidator

from coopenv.base.errors import CoopenvError, check_one_of, listed, regular, shortened, shown, suggest

CHANGE = "scenario | {'dotted.key': value} returns a changed scenario"
_METHODS = ("figure", "model_dump", "model_dump_json")
MOST_BYTES = 4 * 2**20  # of a file; 20,000 landmarks take one or two million
MOST_KEYS, MOST_PARTS = 120_000, 16
"""Tables and parts of all keys of a file, some two kilobytes each in Python's parser, and parts of one dotted key."""


class Section(BaseModel):
    """A frozen section of a TOML file; unknown keys are refused.

    The meaning of a key is the docstring below its field. It is read from the source when it is asked for: reading all
    of them takes a third of the time to import the schema.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)

    def __setattr__(self, name: str, value: Any = None) -> None:
        """Refuse a change; overrides of `load_scenario` return a changed copy."""
        raise CoopenvError(f"{type(self).__name__}.{name}: is frozen; {CHANGE}")

    __setitem__ = __delitem__ = __delattr__ = __setattr__

    def __contains__(self, key: str) -> bool:
        """Return whether there is a dotted key."""
        with suppress(AttributeError, CoopenvError):
            self[key]
            return True
        return False

    def __getitem__(self, key: str) -> Any:
        """Return the value of a dotted key, as overrides name it; an entry of a list by index or name."""
        return reduce(_entry, str(key).split("."), self)

    if not TYPE_CHECKING:  # which knows the attributes
        __or__ = __ror__ = __setattr__

        def __getattr__(self, name: str) -> Any:
            """Raise an error that lists the keys."""
            try:
                return super().__getattr__(name)
            except AttributeError:
                keys = [] if name.startswith("_") else [*type(self).model_fields]
                near = suggest(name, [*keys, *(m for m in _METHODS if hasattr(type(self), m))])
                known = f"{near}; keys: {listed(keys, 40)}; {CHANGE}, model_dump() data" if keys else ""
                raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'{known}") from None

    @classmethod
    @cache
    def meanings(cls) -> dict[str, str]:
        """Return the meaning, or at least the unit, of every field that has one, by name."""
        found: dict[str, str] = {}
        for model in reversed([kind for kind in cls.__mro__ if issubclass(kind, Section) and kind is not Section]):
            with suppress(OSError, TypeError):  # a class that a program has made has no source
                [definition] = ast.parse(dedent(inspect.getsource(model))).body
                for field, text in pairwise(getattr(definition, "body", [])):
                    match field, text:
                        case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(words))):
                            found[name] = inspect.cleandoc(words)
        fields = cls.model_fields.items()
        units = {name: part.symbol for name, info in fields for part in info.metadata if hasattr(part, "symbol")}
        return units | found | {name: info.description for name, info in fields if info.description}

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: Any, handler: Any) -> Any:
        """Return the JSON schema with the meanings of the fields."""
        schema = handler(core_schema)
        properties = handler.resolve_ref_schema(schema).get("properties", {})
        for name, text in cls.meanings().items():
            if name in properties:
                properties[name]["description"] = text
        return schema


def _entry(node: Any, key: str) -> Any:
    if not isinstance(node, tuple | dict):
        return getattr(node, key)
    listing = node if isinstance(node, dict) else dict(enumerate(node))
    named = {name: entry for i, entry in listing.items() for name in (str(i), getattr(entry, "name", str(i)))}
    check_one_of("unknown entry", key, named)
    return named[key]


P = TypeVar("P", bound=Section)
Model = TypeVar("Model", bound=BaseModel)


def overlaid(base: P, part: P | None) -> P:
    """Return a section with what another one gives in place of its own entries; tables within are overlaid likewise."""
    if part is None:
        return base
    changes = {}
    for name in part.model_fields_set:
        own, given = getattr(base, name), getattr(part, name)
        changes[name] = overlaid(own, given) if isinstance(own, Section) and isinstance(given, Section) else given
    return base.model_copy(update=changes)


def read_toml(path: Path, error: type[CoopenvError] = CoopenvError, where: str | None = None) -> dict[str, Any]:
    """Return the contents of a TOML file.

    Args:
        path: of the file.
        error: class of the error.
        where: name of the file in the error (default: its path).

    Raises:
        CoopenvError: of class `error`; the file cannot be read, is too large, or is not valid TOML.
    """
    where = where or str(path)
    try:
        with regular(path).open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise error(f"{where}: larger than {MOST_BYTES // 2**20} MiB")
        return toml_of(content.decode("utf-8-sig"))
    except OSError as problem:
        raise error(f"{where}: cannot be read ({problem.strerror or problem})") from None
    except UnicodeDecodeError:
        raise error(f"{where}: not a text file, expected TOML") from None
    except RecursionError:
        raise error(f"{where}: {TOO_DEEP}") from None
    except ValueError as problem:
        raise (problem if isinstance(problem, error) else error(f"{where}: not valid TOML: {problem}")) from None


_SKIPPED = re.compile(
    r"""\"{3}(?:[^"\\]++|\\.|"(?!""))*+(?:"{3,5}|\Z)|'{3}(?:[^']++|'(?!''))*+(?:'{3,5}|\Z)"""
    r"""|"(?:[^"\\\n]++|\\[^\n])*+"?|'[^'\n]*+'?|\#[^\n]*+""",
    re.DOTALL,
)
"""Strings and comments; one without an end goes on to the end of its line, or with three quotes to that of the file."""
_LONG_KEY = re.compile(rf'(?<![\w"-])["\w-]++(?:[ \t]*+\.[ \t]*+["\w-]++){{{MOST_PARTS}}}')
_HEADER = re.compile(r"^[ \t]*\[[^,\n]*+$", re.MULTILINE)
_FLOAT = re.compile(r'(?<![\w".-])[+-]?\d++\.\d[\w+-]*+(?![ \t]*[.=])')


def toml_of(text: str) -> dict[str, Any]:
    """Return the contents of a TOML document whose keys are limited.

    Python's parser takes time and memory with the square of a dotted key's length. So parts are counted before.

    Raises:
        ValueError: it is not valid, a key has more than `MOST_PARTS`, or all together more than `MOST_KEYS`.
    """
    text = text.replace("\r\n", "\n")
    plain = _SKIPPED.sub('"', text)
    if found := _LONG_KEY.search(plain):
        raise ValueError(f"{shown(found[0])}: a dotted key of more than {MOST_PARTS} parts")
    dots = plain.count(".") - sum(1 for _ in _FLOAT.finditer(plain))
    headers = {found[0] for found in _HEADER.finditer(plain)}
    keys = plain.count("=") + plain.count("{") + dots + sum(1 + header.count(".") for header in headers)
    if keys > MOST_KEYS:
        raise ValueError(f"its keys have {keys:,} parts, more than {MOST_KEYS:,}")
    return tomllib.loads(text)


def validated(model: type[Model], raw: Any, where: str, error: type[CoopenvError] = CoopenvError) -> Model:
    """Return plain data as a model.

    Args:
        model: of the data.
        raw: tables, lists and values; a text or bytes: JSON, which is validated strictly.
        where: name of the origin in the error.
        error: class of the error.

    Raises:
        CoopenvError: of class `error`; one line that names the field.
    """
    try:
        return parsed(model, raw)
    except ValidationError as problem:
        raise error(one_line(problem, where, model)) from None


SMALL = 2**17
"""Characters of a JSON text all of whose problems are counted. Each problem takes a kilobyte."""


def parsed(model: type[Model], raw: Any) -> Model:
    """Return plain data as a model; lists that are not part of a small text are read up to their first problem.

    Raises:
        ValidationError: the data are not of the model.
    """
    is_text = isinstance(raw, str | bytes)
    if is_text and len(raw) <= SMALL:
        return model.model_validate_json(raw, strict=True)
    validator = _failing_fast(model)
    made: Model = validator.validate_json(raw, strict=True) if is_text else validator.validate_python(raw)
    return made


@cache
def _failing_fast(model: type[BaseModel]) -> SchemaValidator:
    def changed(node: dict[str, Any]) -> dict[str, Any]:
        return node | {"fail_fast": True} if node.get("type") in ("list", "tuple", "set") else node

    model.model_rebuild()  # builds what is deferred
    return SchemaValidator(rewritten(model.__pydantic_core_schema__, changed))


def rewritten(node: Any, change: Callable[[dict[str, Any]], Any]) -> Any:
    """Return a schema with each of its tables changed, the innermost first."""
    if isinstance(node, dict):
        return change({key: rewritten(part, change) for key, part in node.items()})
    return type(node)(rewritten(part, change) for part in node) if type(node) in (list, tuple) else node


TOO_DEEP = "lists or tables stand too deep in one another"


def one_line(error: ValidationError, where: str, model: type[BaseModel]) -> str:
    """Return the most helpful of the problems in one line, which begins with `where`; `model` knows the valid keys."""
    details = error.errors(include_url=False)
    # A misspelt key often also leaves a required one missing: the misspelling is what helps.
    first = min(details, key=lambda d: d["type"] != "extra_forbidden")
    # Pydantic puts its own tags of unions into the location; keys of the file are identifiers or stand last.
    loc, unknown = first["loc"], first["type"] == "extra_forbidden"
    keys = [k for i, k in enumerate(loc, 1) if isinstance(k, int) or k.isidentifier() or (unknown and i == len(loc))]
    field = ".".join(shortened(str(part)) for part in keys)
    where = f"{where}: {field}" if field else where
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    if unknown:
        valid = _valid_keys(loc[:-1], model)
        several = sum(detail["type"] == "extra_forbidden" for detail in details) > 2  # it is another kind of file
        hint = (not several and suggest(str(keys[-1]), valid)) or f"; allowed: {', '.join(valid)}"
        return f"{where}: unknown key{hint}{more}"
    if first["type"] in ("union_tag_not_found", "union_tag_invalid"):
        return f"{where}.{_kind_message(first)}{more}"
    message = first["msg"].removeprefix("Value error, ").replace("Tuple should", "List should")
    message = re.sub("a valid dictionary( or instance of .*)?", "an object", message).replace("valid tuple", "list")
    if first["type"] == "missing" and isinstance(keys[-1], int):
        return f"{where.rpartition('.')[0]}: too few entries, number {keys[-1] + 1} is missing{more}"
    if first["type"] == "value_error":  # our own checks: their messages start with the field that they are about
        joint = "." if field and re.match(r"[^\W\d][\w.]*:", message) else ": "
        return f"{where}{joint}{message}{more}"
    if first["type"] == "json_invalid":
        return f"{where}: {TOO_DEEP if 'recursion' in message else message}"
    got = first.get("input")
    given = f", got {shown(got)}" if isinstance(got, bool | int | float | str) else ""
    return f"{where}: {message}{given}{more}"


def _kind_message(detail: Any) -> str:
    """Return the known kinds, for a table whose `kind` is missing, misspelt or unknown."""
    context, given = detail.get("ctx", {}), detail.get("input")
    if "expected_tags" not in context:
        near = get_close_matches("kind", [str(k) for k in given], n=1) if isinstance(given, dict) else []
        return f"{near[0]}: unknown key (did you mean 'kind'?)" if near else "kind: Field required"
    kinds = [tag.strip().strip("'") for tag in context["expected_tags"].split(",")]
    tag = shortened(str(context.get("tag", "")))
    return f"kind: unknown kind '{tag}'{suggest(tag, kinds)}; known: {', '.join(kinds)}"


def _valid_keys(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Return the keys allowed at a location of a validation error, by walking the model's annotations."""
    models: list[Any] = [model]
    for part in location:
        if isinstance(part, int):
            continue
        nested = [
            inner
            for model in models
            if isinstance(part, str) and part in model.model_fields
            for inner in _models_in(model.model_fields[part].annotation)
        ]
        kinds = [m for m in models if "kind" in m.model_fields and m.model_fields["kind"].default == part]
        models = kinds if kinds and len(models) > 1 else nested or models  # a kind and a key may have the same name
    return sorted({name for model in models for name in model.model_fields})


def _models_in(annotation: Any) -> list[Any]:
    if isinstance(annotation, type):
        return [annotation] if issubclass(annotation, BaseModel) else []
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]


def _unit_quaternion(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    norm = math.sqrt(sum(x * x for x in q))
    if abs(norm - 1.0) > 1e-3:
        raise ValueError(f"a rotation needs a unit quaternion, this one has norm {norm:.4g}")
    return (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def _points_somewhere(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if sum(x * x for x in direction) < 1e-12:
        raise ValueError("must not be zero")
    return direction


def _tag_family(name: str) -> str:
    check_one_of("unknown family", name, FAMILIES, ValueError)
    return name


def _readable(text: str) -> str:
    for line in text.splitlines():
        if not line.replace("\t", " ").isprintable():
            raise ValueError(f"control characters are not allowed, got {shown(line)}")
    return text


LARGEST = 1e9
"""Largest magnitude of any quantity, in its own unit: products of four such numbers still fit into single precision."""

Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Vector2 = tuple[Number, Number]
Vector3 = tuple[Number, Number, Number]
Direction = Annotated[Vector3, AfterValidator(_points_somewhere)]
QuaternionWxyz = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_unit_quaternion)]
Positive = Annotated[float, Field(gt=0.0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0.0, le=LARGEST)]
Probability = Annotated[float, Field(ge=0.0, le=1.0)]
Rate = Annotated[float, Field(ge=1e-3, le=1e5)]
PositiveVector2 = tuple[Positive, Positive]
PositiveVector3 = tuple[Positive, Positive, Positive]
NonNegativeVector3 = tuple[NonNegative, NonNegative, NonNegative]
Sample = Literal["sample"]
Word = Annotated[str, AfterValidator(_readable)]
Text = Annotated[str, Field(max_length=10_000), AfterValidator(_readable)]
"""Printed as it is, so that nothing in it may command a terminal."""

FAMILIES = (
    *("tag16h5", "tag25h9", "tag36h10", "tag36h11"),
    *(f"DICT_{n}X{n}_{count}" for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    *("DICT_ARUCO_ORIGINAL", "DICT_ARUCO_MIP_36h12"),
)
"""Families of tags: AprilTag's as they are called there, ArUco's as in OpenCV."""
TagFamily = Annotated[str, AfterValidator(_tag_family)]
