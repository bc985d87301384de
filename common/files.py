"""Files that are whole at any moment: replaced at once, or lengthened by whole lines."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Self, TextIO


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write a file so that a reader finds the old one or the new one, never a half.

    The content goes to a draft beside the file, which takes its place at the end. A device or a pipe is written
    directly.

    Args:
        path: the file; its folder must exist.

    Raises:
        OSError: naming the file; the old one is still there then, and no draft.
    """
    if path.exists() and not path.is_file():
        with _naming(path), path.open("wb") as file:
            yield file
        return
    target = path.resolve()  # a link stays one
    draft = target.with_name(f"{target.name}.{os.getpid()}.tmp")
    try:
        with _naming(path, draft):
            with draft.open("wb") as file:
                yield file
            draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def replacing_text(path: Path) -> Iterator[TextIO]:
    """The same with text, in UTF-8."""
    with replacing(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8")
        yield text
        text.detach()


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that a reader finds the old one or the new one, never a half."""
    with replacing(path) as file:
        file.write(content)


class LinesFile:
    """A new text file to which whole lines are appended; what is appended is in the file at once.

    When a line does not fit any more, because the disk is full for example, the file is cut back to whole lines.
    """

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            OSError: it cannot be created, or is there already.
        """
        self.path = path
        self._file = path.open("xb", buffering=0)
        self._size = 0
        self._failure: OSError | None = None

    def append(self, lines: Iterable[str]) -> list[int]:
        """Append lines, given without their ends.

        Returns:
            where each begins in the file [bytes].

        Raises:
            OSError: naming the file; none of these lines is in it then, nor will any later one be.
        """
        if self._failure is not None:
            raise self._failure
        encoded = [f"{line}\n".encode() for line in lines]
        rest = memoryview(b"".join(encoded))
        try:
            with _naming(self.path):
                while rest:
                    rest = rest[self._file.write(rest) :]
        except OSError as error:
            self._failure = error
            os.ftruncate(self._file.fileno(), self._size)
            raise
        starts = []
        for line in encoded:
            starts.append(self._size)
            self._size += len(line)
        return starts

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        """The file itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()


@contextmanager
def _naming(path: Path, draft: Path | None = None) -> Iterator[None]:
    """Say in errors of the system which file they are about, where they say nothing or name the draft."""
    try:
        yield
    except OSError as error:
        if error.filename not in (None, str(draft)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None
