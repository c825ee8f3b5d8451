"""Mapping and driving with a laser, a distance meter and a compass: all but the recognition of places."""
