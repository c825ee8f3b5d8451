"""Floor plans: the polygon of free space, reading and writing it, and the library of names."""

from cyclic_env.floor_plans.building_names import pool_label
from cyclic_env.floor_plans.building_spec import BuildingSpec
from cyclic_env.floor_plans.files import floor_plan_from_mapping, read_floor_plan, write_floor_plan
from cyclic_env.floor_plans.floor_plan import FloorPlan, polygon_from_corridors, polygon_from_rings
from cyclic_env.floor_plans.generator import generate
from cyclic_env.floor_plans.library import MapName, load_floor_plan, load_floor_plans, map_names, separate_names

__all__ = [
    "BuildingSpec",
    "FloorPlan",
    "MapName",
    "floor_plan_from_mapping",
    "generate",
    "load_floor_plan",
    "load_floor_plans",
    "map_names",
    "polygon_from_corridors",
    "polygon_from_rings",
    "pool_label",
    "read_floor_plan",
    "separate_names",
    "write_floor_plan",
]
