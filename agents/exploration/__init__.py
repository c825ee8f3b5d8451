"""Exploration: frontiers of what has been seen, a costmap around the robot, and a planner that drives to them."""
