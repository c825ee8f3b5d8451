"""Trajectories: dead reckoning, error metrics, and files in the TUM and g2o formats."""
