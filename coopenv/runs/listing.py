"""`coopenv list`: environments, observers, agents and more, one line each."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich import box
from rich.table import Table

from coopenv.base.installation import environment_id, list_agents, list_envs
from coopenv.observers.registry import description, observer_names
from coopenv.policies import find_agent

COLUMNS = {
    "envs": ("name", "vehicles", "landmarks", "motion", "horizon_s"),
    "observers": ("name", "about"),
    "agents": ("name", "kind", "about"),
    "variants": ("name", "of", "about"),
    "scenes": ("name", "options", "about"),
}
"""What the tables show of the rows."""


def environment_rows() -> list[dict[str, Any]]:
    """Return what `list envs` says of every environment that ships with coopenv."""
    from coopenv.scenario import load_scenario

    rows = []
    for name in list_envs():
        scenario = load_scenario(name)
        rows.append(
            {
                "name": name,
                "title": scenario.title,
                "id": environment_id(name),
                "vehicles": len(scenario.vehicles),
                "landmarks": len(scenario.landmarks),
                "motion": "driven" if scenario.driven else "prescribed",
                "horizon_s": scenario.horizon,
            }
        )
    return rows


def observer_rows() -> list[dict[str, Any]]:
    """Return what `list observers` says of every observer."""
    return [{"name": name, "about": description(name)} for name in observer_names()]


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
    """Return one row per entry; texts of the last column that do not fit into the width are wrapped."""
    table = Table(box=box.HORIZONTALS, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for key in columns:
        heading = key.removesuffix("_s") + (" [s]" if key.endswith("_s") else "")
        number = bool(rows) and isinstance(rows[0][key], int | float)
        table.add_column(heading, justify="right" if number else "left", no_wrap=key != columns[-1])
    for row in rows:
        table.add_row(*(_text(row[key]) for key in columns))
    return table


def _text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(value)
    return f"{value:g}" if isinstance(value, float) else str(value)
