"""A file system in memory that notes every operation, as a program of its own.

`lossy_fs.py MOUNT_POINT` mounts it. A line on stdin asks for what was done since the last one: a
pickled list of `disk.Operation` on stdout; the end of stdin unmounts. Needs root, /dev/fuse and
libfuse 3.

SQLite's write-ahead log works on it as it is: locks are kept by the kernel where a file system has
none of its own, and the shared memory beside the log is mapped from the page cache.
"""

from __future__ import annotations

import ctypes.util
import errno
import itertools
import os
import pickle
import stat
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from tests.crash.disk import ROOT, Operation
from tests.waiting import PATIENCE_S

TOP = Path(__file__).parents[2]
MARK = "user.mark"
"""The extended attribute that a mark is written to; it goes into the log like any operation."""


def why_not() -> str:
    """Why it cannot be mounted here; empty when it can."""
    if os.geteuid() != 0:
        return "a file system in memory is mounted by root only"
    if not os.access("/dev/fuse", os.R_OK | os.W_OK):
        return "/dev/fuse is not there"
    if ctypes.util.find_library("fuse3") is None:
        return "libfuse 3 is not installed (Debian: fuse3)"
    return ""


class LossyMount:
    """The mounted file system, from the side of its user."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._program = subprocess.Popen(
            [sys.executable, "-m", "tests.crash.lossy_fs", str(directory)],
            cwd=TOP,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self.take()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._program.communicate(timeout=PATIENCE_S)

    def take(self) -> list[Operation]:
        """Everything that was done since the last call; the first call waits for the mount."""
        assert self._program.stdin is not None
        assert self._program.stdout is not None
        self._program.stdin.write(b"take\n")
        self._program.stdin.flush()
        return pickle.load(self._program.stdout)

    def mark(self, text: str) -> None:
        """Note something between two operations."""
        os.setxattr(self.directory, MARK, text.encode())


@dataclass(slots=True)
class _Node:
    number: int
    mode: int
    names: dict[str, _Node] = field(default_factory=dict)
    """Of a directory."""
    content: bytearray = field(default_factory=bytearray)
    """Of a file."""
    changed_ns: int = field(default_factory=time.time_ns)


def _serve(mount_point: str) -> None:
    """Mount and serve until unmounted."""
    import mfusepy

    def refuse(code: int) -> OSError:
        return mfusepy.FuseOSError(code)

    class LossyFs(mfusepy.Operations):
        use_ns = True

        def __init__(self) -> None:
            self.log: list[Operation] = []
            self._root = _Node(ROOT, stat.S_IFDIR | 0o755)
            self._numbers = itertools.count(ROOT + 1)
            self._open: dict[int, _Node] = {}
            self._handles = itertools.count(1)

        # The one that is asked for

        def init_with_config(self, _connection: Any, config: Any) -> None:
            config.hard_remove = True  # an open file that is removed goes at once, as on a disk
            threading.Thread(target=self._answer, daemon=True).start()

        def _answer(self) -> None:
            for _ in sys.stdin:
                taken, self.log = self.log, []
                pickle.dump(taken, sys.stdout.buffer)
                sys.stdout.buffer.flush()
            subprocess.run(["umount", "-l", mount_point], check=True)
            os._exit(0)  # whoever still has a file open there has no need of it

        # Names

        def _find(self, path: str | None, handle: int | None = None) -> _Node:
            if handle is not None and handle in self._open:
                return self._open[handle]
            node = self._root
            for name in (path or "").split("/"):
                if name and name not in node.names:
                    raise refuse(errno.ENOENT)
                node = node.names[name] if name else node
            return node

        def _parent(self, path: str) -> tuple[_Node, str]:
            directory, _, name = path.rpartition("/")
            return self._find(directory), name

        def _make(self, path: str, mode: int, kind: str) -> _Node:
            parent, name = self._parent(path)
            node = parent.names[name] = _Node(next(self._numbers), mode)
            self.log.append(Operation(kind, node.number, parent.number, name))
            return node

        def _opened(self, node: _Node) -> int:
            handle = next(self._handles)
            self._open[handle] = node
            return handle

        def getattr(self, path: str, fh: int | None = None) -> dict[str, Any]:
            node = self._find(path, fh)
            times = dict.fromkeys(("st_atime", "st_mtime", "st_ctime"), node.changed_ns)
            links = 2 if stat.S_ISDIR(node.mode) else 1
            return {
                "st_mode": node.mode,
                "st_ino": node.number,
                "st_size": len(node.content),
                "st_nlink": links,
                **times,
            }

        def mkdir(self, path: str, mode: int) -> int:
            self._make(path, stat.S_IFDIR | mode, "mkdir")
            return 0

        def create(self, path: str, mode: int, fi: Any = None) -> int:
            return self._opened(self._make(path, stat.S_IFREG | (mode & 0o7777), "create"))

        def unlink(self, path: str) -> int:
            parent, name = self._parent(path)
            node = parent.names.pop(name)
            self.log.append(Operation("unlink", node.number, parent.number, name))
            return 0

        def link(self, target: str, source: str) -> int:
            (parent, name), node = self._parent(target), self._find(source)
            parent.names[name] = node
            self.log.append(Operation("link", node.number, parent.number, name))
            return 0

        def rmdir(self, path: str) -> int:
            if self._find(path).names:
                raise refuse(errno.ENOTEMPTY)
            return self.unlink(path)

        def rename(self, old: str, new: str) -> int:
            (parent, name), (new_parent, new_name) = self._parent(old), self._parent(new)
            node = parent.names.pop(name)
            new_parent.names[new_name] = node
            numbers = (node.number, parent.number, name, new_parent.number, new_name)
            self.log.append(Operation("rename", *numbers))
            return 0

        def readdir(self, path: str, fh: int) -> list[str]:
            return [".", "..", *self._find(path, fh).names]

        def opendir(self, path: str) -> int:
            return self._opened(self._find(path))

        # Content

        def open(self, path: str, flags: int) -> int:
            node = self._find(path)
            if flags & os.O_TRUNC:
                self._truncate(node, 0)
            return self._opened(node)

        def read(self, path: str, size: int, offset: int, fh: int) -> bytes:
            return bytes(self._open[fh].content[offset : offset + size])

        def write(self, path: str, data: bytes, offset: int, fh: int) -> int:
            node = self._open[fh]
            end = offset + len(data)
            if len(node.content) < end:
                node.content.extend(bytes(end - len(node.content)))
            node.content[offset:end] = data
            node.changed_ns = time.time_ns()
            self.log.append(Operation("write", node.number, offset=offset, data=data))
            return len(data)

        def truncate(self, path: str, length: int, fh: int | None = None) -> int:
            self._truncate(self._find(path, fh), length)
            return 0

        def _truncate(self, node: _Node, length: int) -> None:
            node.content.extend(bytes(max(0, length - len(node.content))))
            del node.content[length:]
            node.changed_ns = time.time_ns()
            self.log.append(Operation("truncate", node.number, offset=length))

        def fsync(self, path: str, datasync: int, fh: int) -> int:
            self.log.append(Operation("sync", self._open[fh].number))
            return 0

        fsyncdir = fsync

        def release(self, path: str, fh: int) -> int:
            del self._open[fh]
            return 0

        releasedir = release

        # The rest

        def setxattr(
            self, path: str, name: str, value: bytes, options: int, position: int = 0
        ) -> int:
            if name != MARK:
                raise refuse(errno.ENOTSUP)
            self.log.append(Operation("mark", name=value.decode()))
            return 0

        def statfs(self, path: str) -> dict[str, int]:
            blocks = 2**20
            return {
                "f_bsize": 4096,
                "f_frsize": 4096,
                "f_blocks": blocks,
                "f_bfree": blocks,
                "f_bavail": blocks,
                "f_files": blocks,
                "f_ffree": blocks,
                "f_favail": blocks,
                "f_namemax": 255,
            }

        def _nothing(self, *_: Any) -> int:
            return 0

        chmod = chown = utimens = _nothing

    mfusepy.FUSE(LossyFs(), mount_point, foreground=True, nothreads=True, fsname="dcam-lossy")


if __name__ == "__main__":
    _serve(sys.argv[1])
