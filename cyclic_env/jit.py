"""Compilation of the numeric kernels by numba, once for each installation; the results are cached on disk."""

from __future__ import annotations

import hashlib
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

NOTICE_DELAY = 2.0
"""Seconds; loading compiled code from the cache takes less, compiling takes more."""


def compiled(function: Callable[..., Any], *, counts_references: bool = False) -> Any:
    """Compile `function` at its first call, with strict IEEE arithmetic and without the GIL.

    No operations are fused or reordered, so that a row of a batch is bit-equal to a single robot, and the kernels equal
    their NumPy twins. Most kernels neither make nor keep objects, so they need not count references: counting is
    atomic, and made two threads on the same arrays slower than one.
    """
    kernel: Any = njit(cache=True, nogil=True, error_model="numpy", _nrt=counts_references)(function)  # pyright: ignore[reportCallIssue]
    # numba's cache notices changes of a kernel's own file only, but kernels of other files are compiled into it.
    kernel._cache._cache_file._source_stamp = _sources_digest(Path(function.__code__.co_filename))
    return kernel


@cache
def _sources_digest(file: Path) -> str:
    """Return a digest of a source file and of all files that it imports from its own package and from this one."""
    sources, waiting = set[Path](), [file.resolve()]
    while waiting:
        source = waiting.pop()
        if source not in sources:
            sources.add(source)
            waiting.extend(_imported_files(source))
    digest = hashlib.sha256()
    for source in sorted(sources):
        digest.update(source.read_bytes())
    return digest.hexdigest()


@cache
def _imported_files(file: Path) -> list[Path]:
    """Return the files of the modules that a source file imports from its own package and from this one."""
    root = file.parent
    while (root / "__init__.py").exists():
        root = root.parent
    files = []
    for name in re.findall(r"^\s*(?:from|import) ([\w.]+)", file.read_text(encoding="utf-8"), re.MULTILINE):
        for folder in {root, Path(__file__).resolve().parents[1]}:
            path = folder.joinpath(*name.split("."))
            files += [one for one in (path.with_suffix(".py"), path / "__init__.py") if one.is_file()]
    return files


def num_cores() -> int:
    """Return how many cores this process may use: kernels run without the GIL, so threads share them."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def inlined(function: Callable[..., Any]) -> Any:
    """Compile `function` into its callers, since numba can't return a tuple that holds a record."""
    return njit(inline="always")(function)


def _call_c(context: Any, address: Any, arguments: Any) -> Any:
    """Call, from a kernel, the C function at an address with a tuple of arguments: int64, pointers or float64.

    The function's result is ignored, and it must not need the GIL. A call from Python would take longer than many such
    functions themselves.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kinds = [context.get_value_type(kind) for kind in arguments]
        pointer = builder.inttoptr(values[0], ir.FunctionType(ir.VoidType(), kinds).as_pointer())
        builder.call(pointer, cgutils.unpack_tuple(builder, values[1]))
        return context.get_dummy_value()

    return types.void(address, arguments), generate


call_c: Any = intrinsic(_call_c)


@cache
def _say_compiling() -> None:
    print("cyclic_env: compiling its kernels, once for this installation; about 20 s ...", file=sys.stderr, flush=True)


@contextmanager
def compile_notice() -> Iterator[None]:
    """Tell the user on stderr that kernels are being compiled, if the block takes long."""
    timer = threading.Timer(NOTICE_DELAY, _say_compiling)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
