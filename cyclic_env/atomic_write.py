"""Write files whole or not at all, and check before hours of work that they can be written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from cyclic_env.errors import ConfigError


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a path to write to, which replaces the file `path` at the end of the block.

    If the block raises, the old file stays. The yielded path lies beside the file, has its suffix, and belongs to this
    process alone. Devices and pipes are written to directly.

    Raises
    ------
    OSError
        Naming `path`, if it can't be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        yield path
        return
    path = Path(os.path.realpath(path))  # replace the target of a symbolic link, not the link
    part = path.with_name(f".{path.stem[:40]}.{os.getpid()}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_text_atomically(path: str | Path, text: str) -> Path:
    """Write a text in UTF-8, all of it or nothing, and return the path.

    Raises
    ------
    OSError
        Naming `path`, if it can't be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def check_writable(path: Path) -> None:
    """Check that a file can be written, and make its folder.

    Raises
    ------
    ConfigError
        If it can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_fifo():
            return  # opening it would wait for a reader
        there = path.exists()
        path.open("a").close()
        if not there:
            path.resolve().unlink()
    except OSError as error:
        raise ConfigError(f"can't write to {path}: {error.strerror}.") from error


def check_outputs(paths: Iterable[Path], inputs: Iterable[Path] = ()) -> None:
    """Check that all files can be written, that no two of them are the same, and that none is an input.

    Raises
    ------
    ConfigError
        If a check fails.
    """
    read, written = {path.resolve() for path in inputs}, set[Path]()
    for path in paths:
        check_writable(path)
        if path.resolve() in read:
            raise ConfigError(f"{path} is read, and would be overwritten; give another name or folder.")
        if path.resolve() in written:
            raise ConfigError(f"{path} would be written twice; give each file a name of its own.")
        written.add(path.resolve())
