"""Reinforcement learning: vector environments for Stable-Baselines3, features and training (extra ``train``)."""

from __future__ import annotations

from gymnasium.envs.registration import register, registry

if "CyclicLoopHeadings-v0" not in registry:
    register(
        id="CyclicLoopHeadings-v0",
        entry_point="agents.rl.headings.env:CyclicLoopHeadingsEnv",
        vector_entry_point="agents.rl.headings.env:CyclicLoopHeadingsVectorEnv",
    )
