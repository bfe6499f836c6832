"""Files at any URL that fsspec knows: s3://, gs://, sftp://, https:// ..."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from daemon.errors import HardwareError, UsageError, WorkFailedError
from drivers.libraries import how_to_install


class StorageError(HardwareError):
    """A storage did not answer: that says nothing of the frame."""


@dataclass(frozen=True, slots=True)
class RemotePath:
    """A directory or a file at a URL."""

    url: str

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> RemotePath:
        return RemotePath(f"{self.url.rstrip('/')}/{name}")

    @property
    def name(self) -> str:
        """The last part."""
        return _name(self.url)

    def read_bytes(self) -> bytes:
        """The file's content. Raises FileNotFoundError, StorageError, UsageError."""
        files, path = _opened(self.url)
        try:
            content: bytes = files.cat_file(path)
        except FileNotFoundError:
            raise
        except Exception as error:  # whatever the storage's library raises
            raise _unanswered(self.url, error) from error
        return content

    def write_bytes(self, content: bytes) -> None:
        """Write the file as a whole. Raises StorageError, UsageError."""
        files, path = _opened(self.url)
        try:
            files.makedirs(path.rpartition("/")[0], exist_ok=True)
            files.pipe_file(path, content)
        except Exception as error:  # as above
            raise _unanswered(self.url, error) from error

    def glob(self, pattern: str) -> list[RemotePath]:
        """What matches below it, in order. Raises StorageError, UsageError.

        Lists no directory below the last wildcard: those of an archive hold millions of images.
        """
        files, path = _opened(self.url)
        found = [path.rstrip("/")]
        try:
            for part in pattern.split("/"):
                if set(part) & set("*?["):
                    children = [child for parent in found for child in _listed(files, parent)]
                    found = [child for child in children if fnmatchcase(_name(child), part)]
                else:
                    named = [f"{parent}/{part}" for parent in found]
                    found = [child for child in named if _is_there(files, child)]
        except Exception as error:  # as above
            raise _unanswered(self.url, error) from error
        return [RemotePath(files.unstrip_protocol(one)) for one in sorted(found)]


def _listed(files: Any, path: str) -> list[str]:
    try:
        return [str(child).rstrip("/") for child in files.ls(path, detail=False)]
    except (FileNotFoundError, NotADirectoryError):
        return []


def _is_there(files: Any, path: str) -> bool:
    """As `exists`, which takes a storage that does not answer for a no."""
    try:
        files.info(path)
    except FileNotFoundError:
        return False
    return True


def _name(path: str) -> str:
    return path.rpartition("/")[2]


def is_url(text: str) -> bool:
    """Whether it names a storage rather than a directory of this computer."""
    return "://" in text


def _opened(url: str) -> tuple[Any, str]:
    """The storage, opened once in a process, and the path there."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        cure = how_to_install("fsspec", extra="archive", there="name a directory")
        msg = f"{url}: a URL needs fsspec: {cure}"
        raise WorkFailedError(msg) from None
    try:
        files, path = url_to_fs(url)
    except (ImportError, ValueError) as error:  # its text names the library that is missing
        msg = f"{url}: {error}"
        raise UsageError(msg) from None
    except Exception as error:  # a wrong host or key
        raise _unanswered(url, error) from error
    return files, str(path)


def _unanswered(url: str, error: Exception) -> StorageError:
    text = " ".join(str(error).split()) or type(error).__name__
    return StorageError(f"{url}: {text}; check address, access and network, then run it again")
