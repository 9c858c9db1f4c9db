"""Classes and functions of the user's own, named by import path: `file.py:Name` or `package.module:Name`."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from hashlib import sha256
from importlib import import_module
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from traceback import extract_tb
from types import CodeType, ModuleType
from typing import Any

from coopenv.base.errors import CoopenvError, error_text, shown, suggest


def is_reference(text: str) -> bool:
    """Return whether a text is meant to name a place in code."""
    return ":" in text


def absolute(reference: str, folder: Path | None = None) -> str:
    """Return a reference, in which a file is looked for in a folder (None: the current one), as one for any folder."""
    place, _, name = reference.rpartition(":")
    return f"{_file(place, folder)}:{name}" if place.endswith(".py") else reference


def load(reference: str) -> Any:
    """Return the object of a reference.

    Modules are looked for in the current folder too, and those that a file imports in its own. A file is loaded once,
    and again after it has changed.

    Raises:
        CoopenvError: there is no such file, module or name, or its code raises something.
    """
    place, _, name = reference.rpartition(":")
    if not place or not name.isidentifier():
        raise CoopenvError(f"'{reference}': expected file.py:Name or package.module:Name")
    path = _file(place) if place.endswith(".py") else None
    if path is not None and not path.is_file():
        raise CoopenvError(f"'{reference}': no such file: {path}")
    try:
        if path is not None:
            module = _module_of(path, path.stat().st_mtime_ns)
        else:
            with _importing_from(Path.cwd()):
                module = import_module(place)
    except (Exception, SystemExit) as error:  # anybody's code
        raise CoopenvError(f"'{reference}' cannot be loaded: {error_text(error)}") from error
    if not hasattr(module, name):
        known = [known for known in vars(module) if not known.startswith("_")]
        raise CoopenvError(f"'{reference}': no '{name}' in {place}{suggest(name, known)}")
    return getattr(module, name)


@contextmanager
def blamed(subject: str) -> Iterator[None]:
    """Turn exceptions of a user's code into a `CoopenvError` with the subject, the exception and the line.

    Raises:
        CoopenvError: it raises something; its own errors of this kind stay as they are.
    """
    try:
        yield
    except CoopenvError:
        raise
    except (Exception, SystemExit) as error:
        last = extract_tb(error.__traceback__)[-1]
        where = f"{Path(last.filename).name}:{last.lineno}"
        raise CoopenvError(f"{subject} failed at {where}: {error_text(error)}") from error


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
