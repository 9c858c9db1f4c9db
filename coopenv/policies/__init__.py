"""Policies: scripted ones here, and the loader of everything in `agents/`."""

from coopenv.policies.base import Policy, act, decide
from coopenv.policies.loader import AgentCard, load_agent, load_policy, read_card

__all__ = ["AgentCard", "Policy", "act", "decide", "load_agent", "load_policy", "read_card"]
