"""A file is there whole, or as it was."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cyclic_env.atomic_write import atomic_write, check_outputs, check_writable, write_text_atomically
from cyclic_env.errors import ConfigError


def test_a_file_that_is_done_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    file = tmp_path / "a b ü.txt"
    for text in ("first", "second"):
        with atomic_write(file) as part:
            assert part.suffix == file.suffix
            part.write_text(text)
    assert file.read_text() == "second"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_one_that_breaks_off_leaves_what_was(fault: BaseException, tmp_path: Path) -> None:
    file = tmp_path / "kept.txt"
    file.write_text("whole")

    def break_off() -> None:
        with atomic_write(file) as part:
            part.write_text("half")
            raise fault

    with pytest.raises((KeyboardInterrupt, OSError)) as caught:
        break_off()
    if isinstance(caught.value, OSError):
        assert str(caught.value) == f"[Errno 28] No space left on device: '{file}'"
    assert file.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path: Path) -> None:
    link, file = tmp_path / "link.txt", tmp_path / "file.txt"
    link.symlink_to(file)
    with atomic_write(link) as part:
        part.write_text("there")
    assert link.is_symlink()
    assert file.read_text() == "there"
    with atomic_write("/dev/null") as part:
        part.write_text("gone")
    assert Path("/dev/null").is_char_device()


def test_a_pipe_is_written_to_under_its_link(tmp_path: Path) -> None:
    """As with ``--json /dev/stdout | cat`` and ``--json >(cat)``."""
    reader, writer = os.pipe()
    write_text_atomically(f"/dev/fd/{writer}", "through")
    assert os.read(reader, 100) == b"through"
    os.close(reader)
    os.close(writer)
    os.mkfifo(tmp_path / "fifo")
    check_writable(tmp_path / "fifo")  # and does not wait for its reader


def test_to_check_an_output_leaves_no_trace(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "later")
    check_outputs([link, tmp_path / "new" / "file"])
    assert link.is_symlink()
    assert not (tmp_path / "later").exists()
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(ConfigError, match="written twice"):
        check_outputs([link, tmp_path / "later"])


def test_two_processes_that_write_one_file_leave_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "shared.txt"
    with atomic_write(file) as first:
        first.write_text("first")
        monkeypatch.setattr("os.getpid", lambda: -1)  # another process
        with atomic_write(file) as second:
            second.write_text("second")
        assert file.read_text() == "second"
    assert file.read_text() == "first"
    assert list(tmp_path.iterdir()) == [file]
