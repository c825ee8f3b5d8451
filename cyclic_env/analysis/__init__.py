"""Measurements of floor plans."""
