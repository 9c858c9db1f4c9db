"""The installed package and its machine; environments, files and code of the user's own by name.

A class or function of the user's own is named by its import path: `file.py:Name` or `package.module:Name`.
"""

import ast
import hashlib
import os
import platform
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from functools import cache
from hashlib import sha256
from importlib import import_module, metadata
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from shutil import copyfile, copytree, ignore_patterns
from traceback import extract_tb
from types import CodeType, ModuleType
from typing import Any

from coopenv.base.errors import CoopenvError, UnknownEnvironmentError, error_text, shortened, shown, suggest

SCENES = ("lane", "roots", "tree", "random", "ring", "road", "crossroad")
"""Kinds of parametric scenes, `lane:20`; see `coopenv.scenario.scenes`."""

EXPECTED = "expected a scenario (.toml), log (.mcap) or ROS bag (.bag, .db3, a folder with metadata.yaml)"
BAGS = (".db3", ".bag")  # suffixes of ROS bags, which are taken for log files by mistake


@cache
def data_directory(kind: str) -> Path:
    """Return the folder of a `kind`, inside the installed wheel, else beside the checkout's package.

    Kinds are `envs`, `agents`, `examples/bags` and `examples/fleet`.
    """
    package = Path(__file__).resolve().parents[1]
    shipped = package / "data" / kind
    return shipped if shipped.is_dir() else package.parent / kind


def is_installed(path: Path) -> bool:
    """Return whether a path lies in the package, as the data of a wheel do; those of a checkout lie beside it."""
    return path.resolve().is_relative_to(Path(__file__).resolve().parents[1])


def sample_bags(folder: str | Path = "bags") -> Path:
    """Copy the sample bags to a folder, which is made if need be, and return its path.

    A drive of two fake cars in three forms, `mcap`, `sqlite3` and `ros1.bag`, and the map of its topics, `topics.toml`.
    Files of these names are replaced.

    Raises:
        OutputError: the folder cannot be written to.
    """
    return _copied("examples/bags", folder, "make.py")


def copy_examples(folder: str | Path = "examples") -> Path:
    """Copy the examples, programs, scenarios, fleets and bags, to a folder, and return its path.

    Files of these names are replaced.

    Raises:
        OutputError: the folder cannot be written to.
    """
    return _copied("examples", folder, "notebooks")


def _copied(name: str, folder: str | Path, left_out: str) -> Path:
    from coopenv.base.files import writing  # `import coopenv` needs no files

    source = data_directory(name)
    if Path(folder).resolve() == source.resolve():
        return Path(folder)
    with writing(folder):
        left = ignore_patterns(left_out, "__*")
        return copytree(source, Path(folder), ignore=left, copy_function=copyfile, dirs_exist_ok=True)


def install_command(extra: str) -> str:
    """Return the command that installs an extra: in or from a clone by its folder, or else by the package's name."""
    shipped = Path(__file__).resolve().parents[1] / "data" / "envs"
    clone = not shipped.is_dir() or Path("coopenv", "__init__.py").is_file()
    return f"pip install '{'.' if clone else 'coopenv'}[{extra}]'"


@cache
def message_types(release: str) -> Any:
    """Return the store of message types of a release of ROS, such as ROS2_JAZZY, with those of `coopenv/messages`.

    Raises:
        ImportError: rosbags is not installed.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, folder = get_typestore(Stores[release]), Path(__file__).resolve().parents[1] / "messages"
    for file in folder.rglob("*.msg"):
        kind = file.relative_to(folder).with_suffix("").as_posix()
        store.register(get_types_from_msg(file.read_text(encoding="utf-8"), kind))
    return store


def list_envs() -> list[str]:
    """Return the names of the environments that ship with coopenv: the file stems of `envs/`."""
    return sorted(path.stem for path in data_directory("envs").glob("*.toml"))


def environment_id(name: str) -> str:
    """Return the registered id of an environment: busy_intersection -> coopenv/BusyIntersection-v0."""
    return f"coopenv/{name.title().replace('_', '')}-v0"


def is_scene(text: str) -> bool:
    """Return whether a text is the name of a scene, be it right or wrong in what follows the colon."""
    head, colon, rest = text.partition(":")
    return bool(colon) and head in SCENES and not rest.endswith(".toml") and "/" not in rest


def scenario_path(name_or_path: str | Path) -> Path:
    """Return the file behind an environment name or a path; a folder that is called like an environment is ./NAME.

    Raises:
        UnknownEnvironmentError: there is no such environment or file.
    """
    text, names = str(name_or_path), list_envs()
    if text in names:
        return data_directory("envs") / f"{text}.toml"
    for name in names:
        if text in (environment_id(name), f"coopenv/{name}"):
            raise UnknownEnvironmentError(f"{text}: an id, for gymnasium.make; the environment is '{name}'")
    if not (re.search(r"[/\\]|\.\w+$", text) or os.path.exists(text)):  # noqa: PTH110 (never raises)
        known = [*names, *(f"{kind}:N" for kind in SCENES)]
        near = suggest(text, known)
        raise UnknownEnvironmentError(f"unknown environment {shown(text)}{near}; known: {', '.join(known)}")
    try:
        path = Path(text).expanduser()
        there, is_bag = path.is_file(), path.suffix in BAGS or (path / "metadata.yaml").is_file()
    except (OSError, RuntimeError, ValueError) as error:  # too long, an unknown user's home, a null character
        found = f"no such scenario file: {shown(text)} ({getattr(error, 'strerror', None) or error})"
        raise UnknownEnvironmentError(found) from None
    short = shortened(str(path), 200)
    if is_bag:
        found = f"{path}: a ROS bag is no scenario; it runs with a map of its topics: coopenv run BAG --map topics.toml"
    elif path.is_dir():
        found = f"{short}: a folder; {EXPECTED}; coopenv view opens that of a run"
    elif not there and os.path.exists(path):  # noqa: PTH110 (never raises)
        found = f"{short}: neither a file nor a folder; {EXPECTED}"
    elif not there:
        near = suggest(path.stem, names) or ("" if path.suffix == ".toml" else f"; {EXPECTED}")
        found = f"no such scenario file: {short}{near}"
    elif text.endswith(".toml") or "/" in text or "\\" in text:
        return path
    else:
        found = f"unknown environment {shown(text)}: a file of an unknown kind; {EXPECTED}"
    raise UnknownEnvironmentError(found)


def list_agents() -> list[str]:
    """Return the names of the drivers that ship with coopenv: the folders of `agents/`."""
    return sorted(path.parent.name for path in data_directory("agents").glob("*/agent.toml"))


def version() -> str:
    """Return the installed version, or `unknown` in a checkout that is not installed."""
    return versions("coopenv").get("coopenv", "unknown")


ONE_THREAD: Mapping[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"
)
"""Environment variables that numerical libraries read when they are loaded, here for one thread each."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(*distributions: str) -> dict[str, str]:
    """Return the versions of Python and of those of the distributions that are installed."""
    found = {"python": platform.python_version()}
    for name in distributions:
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Let processes that are started meanwhile see these environment variables."""
    before = {name: os.environ[name] for name in variables if name in os.environ}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name in variables:
            os.environ.pop(name, None)
        os.environ.update(before)


@contextmanager
def needing(words: str) -> Iterator[None]:
    """Turn the absence of a package into a `CoopenvError` that names the feature and the command of installation."""
    try:
        yield
    except ImportError as error:
        raise CoopenvError(f"{words} ({error})") from None


def names_of(given: object) -> list[Any]:
    """Return names, classes or functions as a list: also one alone, or a text with commas between."""
    if isinstance(given, str):
        return [word.strip() for word in given.split(",") if word.strip()]
    if callable(given) or hasattr(given, "predict"):
        return [given]
    if isinstance(given, Iterable):
        return list(given)
    raise CoopenvError(f"expected a name, a class or a list of them, got {shown(given)}")


def is_reference(text: str) -> bool:
    """Return whether a text is meant to name a place in code."""
    return ":" in text


def absolute_reference(reference: str, folder: Path | None = None) -> str:
    """Return a reference, or a path, of a file in a folder (None: the current one) as one for any folder."""
    place, colon, name = reference.rpartition(":")
    if not colon:
        return str(_file(reference, folder))
    return f"{_file(place, folder)}:{name}" if place.endswith(".py") else reference


def beside(reference: str, folder: Path, code: dict[str, Path]) -> str:
    """Return a path or reference of some folder as one to a copy beside; note its file, and imports, in `code`.

    Raises:
        CoopenvError: two different files have one name.
    """
    place, colon, name = absolute_reference(reference, folder).rpartition(":")
    if colon and not place.endswith(".py"):
        return reference
    _add_code(Path(place or name), code)
    return f"{Path(place).name}:{name}" if colon else Path(name).name


def _add_code(path: Path, code: dict[str, Path]) -> None:
    if path.name in code:
        if code[path.name] != path:
            raise CoopenvError(f"{path} and {code[path.name]}: one folder must hold both; give one another name")
        return
    code[path.name] = path
    if path.suffix != ".py":
        return
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in [node.module or ""] if isinstance(node, ast.ImportFrom) else names:
            if (imported := path.with_name(f"{name}.py")).is_file():
                _add_code(imported, code)


def check_reference(reference: str) -> Path | None:
    """Return the file of a reference, None for that of a module, without running any code.

    Raises:
        CoopenvError: it is no reference, there is no such file, or the file does not mention the name.
    """
    place, _, name = reference.rpartition(":")
    if not place or not name.isidentifier():
        raise CoopenvError(f"'{reference}': expected file.py:Name or package.module:Name")
    path = _file(place) if place.endswith(".py") else None
    if path is not None and not path.is_file():
        raise CoopenvError(f"'{reference}': no such file: {path}")
    text = name if path is None else path.read_bytes().decode(errors="replace")
    if not re.search(rf"\b{name}\b|import \*|globals|setattr|__getattr__|exec", text):
        known = re.findall(r"^(?:class|def)\s+(\w+)", text, re.MULTILINE)
        raise CoopenvError(f"'{reference}': no '{name}' in {place}{suggest(name, known)}")
    return path


def load_reference(reference: str) -> Any:
    """Return the object of a reference.

    Modules are looked for in the current folder too, and those that a file imports in its own. A file is loaded once,
    and again after it has changed. What it prints goes to standard error: standard output may be a document.

    Raises:
        CoopenvError: there is no such file, module or name, or its code raises something.
    """
    place, _, name = reference.rpartition(":")
    path = check_reference(reference)
    try:
        with redirect_stdout(sys.stderr), _importing_from(Path.cwd()) if path is None else nullcontext():
            module = _module_of(path, path.stat().st_mtime_ns) if path is not None else import_module(place)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # anybody's code
        raise CoopenvError(f"'{reference}' cannot be loaded: {error_text(error)}") from error
    if not hasattr(module, name):
        known = [known for known in vars(module) if not known.startswith("_")]
        raise CoopenvError(f"'{reference}': no '{name}' in {place}{suggest(name, known)}")
    return getattr(module, name)


def file_digest(path: Path) -> str:
    """Return the digest (SHA-256) of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def blamed(subject: str, kind: type[CoopenvError] = CoopenvError) -> Iterator[None]:
    """Turn exceptions of a user's code into a `CoopenvError` with the subject, the exception and the line.

    Raises:
        CoopenvError: of class `kind`; it raises something. Its own errors of this kind stay as they are.
    """
    try:
        yield
    except (CoopenvError, KeyboardInterrupt):
        raise
    except BaseException as error:
        last = extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        raise kind(f"{subject} failed at {where}: {error_text(error)}") from error


def _file(place: str, folder: Path | None = None) -> Path:
    try:
        path = ((folder or Path()) / Path(place).expanduser()).resolve()
        path.is_file()  # raises here what it would raise later
        return path
    except (OSError, RuntimeError, ValueError) as error:  # too long, an unknown user's home, a null character
        raise CoopenvError(f"{shown(place)}: no such file ({getattr(error, 'strerror', None) or error})") from None


class _FromSource(SourceFileLoader):
    """Reads a file as it is now: bytecode is taken for that of a file of the same size and of the same second."""

    def get_code(self, fullname: str) -> CodeType:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


@cache
def _module_of(path: Path, modified: int) -> ModuleType:
    """Return a file as a module, whose name no other file has."""
    name = f"coopenv_user_{sha256(str(path).encode()).hexdigest()[:12]}_{path.stem}"
    spec = spec_from_file_location(name, path, loader=_FromSource(name, str(path)))
    assert spec is not None and spec.loader is not None  # it ends with .py
    module = sys.modules[name] = module_from_spec(spec)  # where dataclasses look for it
    try:
        with _importing_from(path.parent):
            spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
