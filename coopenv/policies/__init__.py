"""Drivers: scripted ones here, and the loader of everything in `agents/`."""

from coopenv.policies.agents import AgentCard, list_agents, load_agent, read_card
from coopenv.policies.base import Policy

__all__ = ["AgentCard", "Policy", "list_agents", "load_agent", "read_card"]
