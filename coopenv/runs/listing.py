"""`coopenv list`: environments, observers, agents and more, one line each."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.table import Table

from coopenv.api.registration import environment_id
from coopenv.base.installation import list_agents
from coopenv.observers.registry import find, observer_names, obstacle
from coopenv.policies import find_agent
from coopenv.runs.table import number_table
from coopenv.scenario import Scenario

COLUMNS = {
    "envs": ("name", "vehicles", "landmarks", "motion", "horizon_s"),
    "observers": ("name", "about"),
    "agents": ("name", "kind", "about"),
    "variants": ("name", "of", "about"),
    "scenes": ("name", "options", "about"),
}
"""What the tables show of the rows."""


def environment_rows(scenarios: Mapping[str, Scenario]) -> list[dict[str, Any]]:
    """Return what `list envs` says of every environment."""
    return [
        {
            "name": name,
            "title": scenario.title,
            "id": environment_id(name),
            "vehicles": len(scenario.vehicles),
            "landmarks": len(scenario.landmarks),
            "motion": "driven" if scenario.driven else "prescribed",
            "horizon_s": scenario.horizon,
        }
        for name, scenario in scenarios.items()
    ]


def observer_rows() -> list[dict[str, Any]]:
    """Return what `list observers` says of every observer."""
    names = observer_names()
    return [{"name": name, "about": obstacle(name) or _sentence(find(name).__doc__ or "")} for name in names]


def agent_rows() -> list[dict[str, Any]]:
    """Return what `list agents` says of every agent."""
    return [
        {
            "name": agent.name,
            "kind": agent.kind,
            "environments": list(agent.environments),
            "about": _sentence(agent.description),
        }
        for agent in map(find_agent, list_agents())
    ]


def _sentence(text: str) -> str:
    return " ".join(text.split("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def list_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> Table:
    """Return one line per row; what does not fit into the width is cut off at the end of the last column."""
    table = number_table((), ())
    for key in columns:
        cells = [_text(row[key]) for row in rows]
        heading = key.removesuffix("_s") + (" [s]" if key.endswith("_s") else "")
        number = bool(rows) and isinstance(rows[0][key], int | float)
        width = None if key == columns[-1] else max(map(len, [heading, *cells]))
        table.add_column(heading, justify="right" if number else "left", no_wrap=True, min_width=width)
    for row in rows:
        table.add_row(*(_text(row[key]) for key in columns))
    return table


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
