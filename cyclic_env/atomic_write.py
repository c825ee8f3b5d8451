"""Writing files so that they are there whole, or as they were; and, before hours of work, that they can be written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from cyclic_env.errors import ConfigError


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a path to write to, which becomes the file `path` once that is done; else what was there stays.

    It lies beside the file, has its suffix, and is this process's own. A device or a pipe is written to as it is.

    Parameters
    ----------
    path : str or path

    Raises
    ------
    OSError
        Naming `path`, if it can't be written.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        yield path
        return
    path = Path(os.path.realpath(path))  # what a symbolic link points to is replaced, not the link
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
    """Write a text in UTF-8, all of it or nothing; return the path.

    Raises
    ------
    OSError
        Naming `path`, if it can't be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)


def check_writable(path: Path) -> None:
    """Check, before hours of work, that the file can be written.

    Raises
    ------
    ConfigError
        If it can't.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_fifo():
            return  # who opens it waits for a reader
        there = path.exists()
        path.open("a").close()
        if not there:
            path.resolve().unlink()
    except OSError as error:
        raise ConfigError(f"can't write to {path}: {error.strerror}.") from error


def check_outputs(paths: Iterable[Path], inputs: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that all files can be written, each its own, and none over what is read.

    Raises
    ------
    ConfigError
        If it is not so.
    """
    read, written = {path.resolve() for path in inputs}, set[Path]()
    for path in paths:
        check_writable(path)
        if path.resolve() in read:
            raise ConfigError(f"{path} would be written over, but it is read; give another name or folder.")
        if path.resolve() in written:
            raise ConfigError(f"{path} would be written twice; give each file a name of its own.")
        written.add(path.resolve())
