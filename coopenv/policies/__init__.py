"""Drivers: scripted ones here, and the loader of everything in `agents/`."""

from coopenv.policies.agents import AgentCard, load_agent, read_card
from coopenv.policies.base import Policy

__all__ = ["AgentCard", "Policy", "load_agent", "read_card"]
