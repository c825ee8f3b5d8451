"""A file is there whole, or as it was."""

from __future__ import annotations

from pathlib import Path

import pytest

from cyclic_env.whole_file import whole_file


def test_a_file_that_is_done_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    file = tmp_path / "a b ü.txt"
    for text in ("first", "second"):
        with whole_file(file) as part:
            assert part.suffix == file.suffix
            part.write_text(text)
    assert file.read_text() == "second"
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_one_that_breaks_off_leaves_what_was(fault: BaseException, tmp_path: Path) -> None:
    file = tmp_path / "kept.txt"
    file.write_text("whole")

    def break_off() -> None:
        with whole_file(file) as part:
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
    with whole_file(link) as part:
        part.write_text("there")
    assert link.is_symlink()
    assert file.read_text() == "there"
    with whole_file("/dev/null") as part:
        part.write_text("gone")
    assert Path("/dev/null").is_char_device()


def test_two_processes_that_write_one_file_leave_it_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "shared.txt"
    with whole_file(file) as first:
        first.write_text("first")
        monkeypatch.setattr("os.getpid", lambda: -1)  # another process
        with whole_file(file) as second:
            second.write_text("second")
        assert file.read_text() == "second"
    assert file.read_text() == "first"
    assert list(tmp_path.iterdir()) == [file]
