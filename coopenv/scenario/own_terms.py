"""Terms of one's own in the plain data of a scenario: where their files are, and a scenario without them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from coopenv import user_code
from coopenv.scenario.term_tables import GROUPS, REWARD_TERMS, TERMINATION_CONDITIONS

SECTIONS = ("observation", "reward", "termination")
"""Parts of a scenario with a table `custom`."""


def located(raw: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a scenario whose own terms name absolute files; relative ones are looked for in `folder`."""
    result = dict(raw)
    for section in SECTIONS:
        part = result.get(section)
        if isinstance(part, dict) and isinstance(part.get("custom"), dict):
            rows = {name: _located(row, folder) for name, row in part["custom"].items()}
            result[section] = {**part, "custom": rows}
    return result


def _located(row: Any, folder: Path) -> Any:
    if isinstance(row, dict) and "function" in row:
        return {**row, "function": _located(row["function"], folder)}
    if isinstance(row, str) and user_code.is_reference(row):
        return user_code.absolute(row, folder)
    return row


def without_own_terms(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scenario with terms of coopenv only, which is what a recording says of it: it must not name code."""
    result = dict(raw)
    for section in SECTIONS:
        part = result.get(section)
        if isinstance(part, dict):
            result[section] = _without(section, {key: value for key, value in part.items() if key != "custom"})
    return result


def _without(section: str, part: dict[str, Any]) -> dict[str, Any]:
    if section == "termination":
        return {key: value for key, value in part.items() if key in TERMINATION_CONDITIONS.built_in}
    if section == "reward" and isinstance(part.get("weights"), dict):
        known = {name: weight for name, weight in part["weights"].items() if name in REWARD_TERMS.built_in}
        return {**part, "weights": known}
    if section == "observation" and isinstance(part.get("include"), list):
        return {**part, "include": [group for group in part["include"] if group in GROUPS] or list(GROUPS)}
    return part
