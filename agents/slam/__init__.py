"""Localization and mapping with a laser, a distance meter and a compass: scan matching, keyframes and a pose graph."""
