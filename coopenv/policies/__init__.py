"""Drivers: scripted ones here, and the loader of everything in `agents/`."""

from coopenv.policies.base import Policy
from coopenv.policies.loader import AgentCard, load_agent, read_card

__all__ = ["AgentCard", "Policy", "load_agent", "read_card"]
