"""Policies for CyclicLoop: they see observations only, never an info, never the inside of the environment.

Privileged ones, which see the truth, are bounds to compare with; they are marked as such.

The explorer and scripted ones come by name from `make_agent`; learned ones from `agents.rl.training`, which needs the
extra ``train``.
"""

from __future__ import annotations

from agents.registry import agent_names, baseline_names, make_agent, privileged_names

__all__ = ["agent_names", "baseline_names", "make_agent", "privileged_names"]
