"""A disk that may lose power: replays what was done to it, and tells what a cut would leave.

A file's content is safe once the file was synced, a name once its directory was. What was not may
be there or not, in every mixture: `Cut` names those that are tried.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TypeAlias

ROOT = 1
SECTOR = 512
"""What a disk writes as a whole."""

Tree: TypeAlias = Mapping[str, bytes | None]
"""Relative path to content; None is a directory."""


@dataclass(frozen=True, slots=True)
class Operation:
    """One thing done to the disk, by inode numbers; what a field does not apply to is empty."""

    kind: str
    """create, mkdir, link, rename, unlink, write, truncate, sync or mark."""
    inode: int = 0
    parent: int = 0
    name: str = ""
    new_parent: int = 0
    new_name: str = ""
    offset: int = 0
    """Of a write; of a truncation the new size."""
    data: bytes = b""


class Cut(StrEnum):
    """What a loss of power leaves of that which was not synced."""

    LOST = "lost"
    """Nothing."""
    NAMES = "names"
    """The names, but not the content: files of no length after a rename, as ext4 may."""
    TORN = "torn"
    """Some names in the order of their making, some sectors of the content in any order."""
    KILLED = "killed"
    """All of it: the power stayed on, the process was killed."""


@dataclass(slots=True)
class _File:
    safe: bytes = b""
    pending: list[Operation] = field(default_factory=list)


@dataclass(slots=True)
class _Directory:
    safe: dict[str, int] = field(default_factory=dict)
    pending: list[dict[str, int | None]] = field(default_factory=list)
    """Names given (inode) and taken away (None) as one, in order."""

    def names(self, count: int) -> dict[str, int]:
        """The names after so many of the pending changes."""
        names: dict[str, int | None] = dict(self.safe)
        for change in self.pending[:count]:
            names |= change
        return {name: inode for name, inode in names.items() if inode is not None}


class Disk:
    """The state of a disk while a log of operations is replayed."""

    def __init__(self) -> None:
        self._inodes: dict[int, _File | _Directory] = {ROOT: _Directory()}

    def do(self, operation: Operation) -> None:
        """Replay one operation."""
        match operation.kind:
            case "create" | "mkdir":
                made = _File() if operation.kind == "create" else _Directory()
                self._inodes[operation.inode] = made
                self._directory(operation.parent).pending.append({operation.name: operation.inode})
            case "link":
                self._directory(operation.parent).pending.append({operation.name: operation.inode})
            case "rename" if operation.parent == operation.new_parent:
                change = {operation.name: None, operation.new_name: operation.inode}
                self._directory(operation.parent).pending.append(change)
            case "rename":
                self._directory(operation.new_parent).pending.append(
                    {operation.new_name: operation.inode}
                )
                self._directory(operation.parent).pending.append({operation.name: None})
            case "unlink":
                self._directory(operation.parent).pending.append({operation.name: None})
            case "write" | "truncate":
                self._file(operation.inode).pending.append(operation)
            case "sync":
                self._sync(self._inodes[operation.inode])

    def sync_all(self) -> None:
        """Everything is safe now."""
        for inode in self._inodes.values():
            self._sync(inode)

    def left_by(self, cut: Cut, seed: int = 0) -> Tree:
        """What is found after the power was cut now."""
        rng = random.Random(seed)
        names: Callable[[_Directory], dict[str, int]]
        content: Callable[[_File], bytes]
        match cut:
            case Cut.LOST:
                names, content = (lambda it: it.safe), (lambda it: it.safe)
            case Cut.NAMES:
                names, content = _all_names, (lambda it: it.safe)
            case Cut.TORN:
                names = lambda it: it.names(rng.randint(0, len(it.pending)))  # noqa: E731
                content = lambda it: _torn(it, rng)  # noqa: E731
            case Cut.KILLED:
                names, content = _all_names, _all_content
        return dict(self._walk(self._directory(ROOT), "", names, content))

    def _walk(
        self,
        directory: _Directory,
        path: str,
        names: Callable[[_Directory], dict[str, int]],
        content: Callable[[_File], bytes],
    ) -> Iterator[tuple[str, bytes | None]]:
        for name, number in sorted(names(directory).items()):
            inode = self._inodes[number]
            if isinstance(inode, _File):
                yield path + name, content(inode)
            else:
                yield path + name, None
                yield from self._walk(inode, f"{path}{name}/", names, content)

    def _sync(self, inode: _File | _Directory) -> None:
        if isinstance(inode, _File):
            inode.safe = _all_content(inode)
        else:
            inode.safe = _all_names(inode)
        inode.pending.clear()

    def _file(self, number: int) -> _File:
        inode = self._inodes[number]
        assert isinstance(inode, _File)
        return inode

    def _directory(self, number: int) -> _Directory:
        inode = self._inodes[number]
        assert isinstance(inode, _Directory)
        return inode


def put(tree: Tree, directory: Path) -> None:
    """Write a tree into an existing directory."""
    for path, content in tree.items():
        if content is None:
            (directory / path).mkdir()
        else:
            (directory / path).write_bytes(content)


def read_tree(directory: Path) -> Tree:
    """What a directory holds."""
    return {
        path.relative_to(directory).as_posix(): path.read_bytes() if path.is_file() else None
        for path in sorted(directory.rglob("*"))
    }


def _all_names(directory: _Directory) -> dict[str, int]:
    return directory.names(len(directory.pending))


def _all_content(file: _File) -> bytes:
    return _written(file.safe, file.pending)


def _torn(file: _File, rng: random.Random) -> bytes:
    """Each sector of each write is there by chance; a change of the size is there or not."""
    kept: list[Operation] = []
    for operation in file.pending:
        if operation.kind == "truncate":
            kept += [operation] * rng.randint(0, 1)
            continue
        likely = rng.choice((0.0, 0.5, 1.0))
        for start in range(0, len(operation.data), SECTOR):
            if rng.random() < likely:
                data = operation.data[start : start + SECTOR]
                kept.append(Operation("write", offset=operation.offset + start, data=data))
    return _written(file.safe, kept)


def _written(content: bytes, operations: list[Operation]) -> bytes:
    """The content after these writes and truncations; holes are zeros."""
    if not operations:
        return content
    image = bytearray(content)
    for operation in operations:
        end = operation.offset + len(operation.data)
        if len(image) < end:
            image.extend(bytes(end - len(image)))
        if operation.kind == "truncate":
            del image[operation.offset :]
        else:
            image[operation.offset : end] = operation.data
    return bytes(image)
