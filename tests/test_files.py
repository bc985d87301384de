"""Files that are whole at any moment."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from waldnet.common.files import LinesFile, replacing, write_atomically


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")

    def fail() -> None:
        with replacing(path) as file:
            file.write(b"half of the n")
            file.flush()
            assert path.read_bytes() == b"old"
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left on device") as caught:
        fail()
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old"
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_errors_name_the_file_and_not_its_draft(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError) as caught:
        write_atomically(Path("no", "file"), b"content")
    assert caught.value.filename == "no/file"


def test_a_device_is_written_and_stays_a_device(tmp_path: Path) -> None:
    write_atomically(Path(os.devnull), b"nothing")
    assert Path(os.devnull).is_char_device()
    with pytest.raises(OSError, match="No space left on device") as caught:
        write_atomically(Path("/dev/full"), b"something")
    assert caught.value.filename == "/dev/full"


def test_a_pipe_is_written() -> None:
    reader, writer = os.pipe()
    write_atomically(Path(f"/dev/fd/{writer}"), b"content")
    assert os.read(reader, 100) == b"content"
    for end in (reader, writer):
        os.close(end)


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "file")
    write_atomically(link, b"content")
    assert link.is_symlink()
    assert (tmp_path / "file").read_bytes() == b"content"


class FullDisk:
    """A raw file on a disk with room for so many bytes more."""

    def __init__(self, file: object, room: int) -> None:
        self._file, self._room = file, room

    def write(self, data: memoryview) -> int:
        if not self._room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written: int = self._file.write(data[: self._room])  # type: ignore[attr-defined]
        self._room -= written
        return written

    def __getattr__(self, name: str) -> object:
        return getattr(self._file, name)


@pytest.mark.parametrize("room", range(12))
def test_on_a_full_disk_whole_lines_stay(tmp_path: Path, room: int) -> None:
    path = tmp_path / "lines"
    with LinesFile(path) as file:
        assert file.append(["one", "two"]) == [0, 4]
        assert file.append([]) == []
        assert file.append(["three"]) == [8]
        assert path.read_text() == "one\ntwo\nthree\n"  # at once
        file._file = FullDisk(file._file, room)  # type: ignore[assignment]
        for _ in range(2):
            with pytest.raises(OSError, match="No space left") as caught:
                file.append(["four", "and five", "and six"])
            assert caught.value.filename == str(path)
        assert path.read_text() == "one\ntwo\nthree\n"


def test_lines_never_go_into_a_file_that_is_there(tmp_path: Path) -> None:
    (tmp_path / "lines").write_text("mine\n")
    with pytest.raises(FileExistsError):
        LinesFile(tmp_path / "lines")
    assert (tmp_path / "lines").read_text() == "mine\n"
