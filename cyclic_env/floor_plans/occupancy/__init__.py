"""Occupancy grids: maps of ROS' ``map_server`` and pictures, and tracing floor plans from them."""
