"""What a row depends on: digests of the environment, the agent and the plan, and the versions of the libraries."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path

from cyclic_env import __version__
from cyclic_env.floor_plans import load_floor_plan
from cyclic_env.tiers import TIERS
from scripts.comparison.suite import Job

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("numpy", "scipy", "numba", "pymunk", "shapely")
DIGESTS = ("environment_digest", "agent_digest", "plan_digest")
VERSIONS = ("cyclic_env", *LIBRARIES)


def provenance(job: Job) -> dict[str, str]:
    """Return what the result of a run depends on, besides the run's settings."""
    plan = load_floor_plan(job.map)
    shape = hashlib.sha256(plan.free_space.wkb + repr(plan.start).encode()).hexdigest()[:12]
    digests = (_environment_digest(), agent_digest(job.agent), shape)
    return dict(zip(DIGESTS, digests, strict=True)) | _versions()


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    return {"cyclic_env": __version__, **{name: version(name) for name in LIBRARIES}}


@lru_cache(maxsize=1)
def _environment_digest() -> str:
    files = [file for file in ROOT.glob("cyclic_env/**/*.py") if "rendering" not in file.parts]
    return _digest(files, json.dumps(repr(TIERS)))


@lru_cache(maxsize=64)
def agent_digest(name: str) -> str:
    """Return a digest of the code of all agents and, if the name is a path, of that model's or module's files."""
    files = [file for file in ROOT.glob("agents/**/*") if file.suffix in (".py", ".json", ".yaml")]
    own = Path(name.partition(":")[0])
    if own.exists():
        files += [file for file in ([own] if own.is_file() else own.rglob("*.zip")) if file.is_file()]
    return _digest(files, name)


def _digest(files: Iterable[Path], text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:12]
