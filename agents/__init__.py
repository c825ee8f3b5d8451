"""Policies for CyclicLoop. They see observations only, never an info or the inside of the environment.

Privileged ones, which see the truth, are bounds to compare with, and marked as such.

`make_agent` returns the explorer and the scripted agents by name. `agents.rl.training` trains agents, which needs the
extra ``train``.
"""

from __future__ import annotations

from agents.registry import agent_label, agent_names, baseline_names, make_agent, privileged_names

__all__ = ["agent_label", "agent_names", "baseline_names", "make_agent", "privileged_names"]
