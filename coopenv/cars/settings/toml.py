"""Plain data as TOML, for the files that are written for the user: environments and maps of topics."""

import json
import re
from collections.abc import Mapping
from typing import Any


def toml_text(table: Mapping[str, Any], path: str = "") -> str:
    """Return plain data as TOML; values that are None are left out."""
    lines, tables = list[str](), list[str]()
    for key, value in table.items():
        name = _key(key)
        rows = [value] if isinstance(value, Mapping) else value if isinstance(value, list) else []
        if rows and all(isinstance(row, Mapping) for row in rows):
            head = f"[{path}{name}]" if isinstance(value, Mapping) else f"[[{path}{name}]]"
            tables += [f"\n{head}\n{toml_text(row, f'{path}{name}.')}" for row in rows]
        elif value is not None:
            lines.append(f"{name} = {_value(value)}\n")
    return "".join(lines + tables)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[\w-]+", key, re.ASCII) else json.dumps(key, ensure_ascii=False)


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{_key(key)} = {_value(part)}' for key, part in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
