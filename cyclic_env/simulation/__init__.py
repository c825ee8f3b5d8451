"""Simulation: physics, laser, the other sensors, and the spatial index of walls."""
