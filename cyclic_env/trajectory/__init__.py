"""Trajectories: dead reckoning, error metrics, and files in the formats TUM and g2o."""
