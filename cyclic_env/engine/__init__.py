"""The engine: one batched step of N robots, which both environments share."""
