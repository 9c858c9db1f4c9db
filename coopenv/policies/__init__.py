"""Policies: scripted ones here, and the loader of everything in `agents/`."""

from coopenv.policies.base import Policy, act, decide, restart
from coopenv.policies.loader import Agent, agents_for, find_agent, load_agent, load_policy

__all__ = [
    "Agent",
    "Policy",
    "act",
    "agents_for",
    "decide",
    "find_agent",
    "load_agent",
    "load_policy",
    "restart",
]
