"""Agents to compare with: classic frontier explorers, and privileged ones that bound what is possible."""
