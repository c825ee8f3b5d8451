"""Detectors of loop closures on a robot's log, and the figure of a run."""
