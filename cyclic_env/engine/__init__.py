"""The engine: one step of N robots. It is the only implementation of the environment."""
