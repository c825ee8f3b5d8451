"""Floor plans: the polygon of free space, reading and writing it, and the library of names."""

from cyclic_env.floor_plans.files import (
    floor_plan_from_mapping,
    floor_plan_from_text,
    floor_plan_to_text,
    read_floor_plan,
    write_floor_plan,
)
from cyclic_env.floor_plans.floor_plan import FloorPlan, polygon_from_corridors, polygon_from_rings
from cyclic_env.floor_plans.library import MapName, load_floor_plan, load_floor_plans, map_names

__all__ = [
    "FloorPlan",
    "MapName",
    "floor_plan_from_mapping",
    "floor_plan_from_text",
    "floor_plan_to_text",
    "load_floor_plan",
    "load_floor_plans",
    "map_names",
    "polygon_from_corridors",
    "polygon_from_rings",
    "read_floor_plan",
    "write_floor_plan",
]
