"""Floor plans: polygons of free space, files, maps of ROS, generated buildings, and the library of names."""

from cyclic_env.floor_plans.floor_plan import FloorPlan, polygon_from_corridors, polygon_from_rings
from cyclic_env.floor_plans.generator.builder import generate
from cyclic_env.floor_plans.generator.names import pool_label
from cyclic_env.floor_plans.generator.spec import BuildingSpec
from cyclic_env.floor_plans.io import (
    floor_plan_from_mapping,
    floor_plan_from_text,
    floor_plan_to_text,
    read_floor_plan,
    write_floor_plan,
)
from cyclic_env.floor_plans.library import (
    MapName,
    PlanPool,
    load_floor_plan,
    load_floor_plans,
    map_names,
    separate_names,
)
from cyclic_env.floor_plans.occupancy.grid import OccupancyGrid, rasterize
from cyclic_env.floor_plans.occupancy.map_server import (
    occupancy_grid_from_mapping,
    read_occupancy_grid,
    write_occupancy_grid,
)
from cyclic_env.floor_plans.occupancy.tracing import Tracing, trace_floor_plan

__all__ = [
    "BuildingSpec",
    "FloorPlan",
    "MapName",
    "OccupancyGrid",
    "PlanPool",
    "Tracing",
    "floor_plan_from_mapping",
    "floor_plan_from_text",
    "floor_plan_to_text",
    "generate",
    "load_floor_plan",
    "load_floor_plans",
    "map_names",
    "occupancy_grid_from_mapping",
    "polygon_from_corridors",
    "polygon_from_rings",
    "pool_label",
    "rasterize",
    "read_floor_plan",
    "read_occupancy_grid",
    "separate_names",
    "trace_floor_plan",
    "write_floor_plan",
    "write_occupancy_grid",
]
