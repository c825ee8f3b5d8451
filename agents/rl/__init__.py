"""Reinforcement learning with Stable-Baselines3: the vector environment, features and training (extra ``train``)."""
