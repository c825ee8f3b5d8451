"""Evaluation of agents: rollouts, one episode for each seed, and their statistics."""
