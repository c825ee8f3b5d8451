"""Generated buildings: their specification, their names and the building of their floor plans."""
