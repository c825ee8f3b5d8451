"""Command lines, run from a checkout."""
