"""A network of one's own with several loopback addresses, for cameras on port 3956.

Two cameras need two addresses, and other programs on this machine may use the port: the calling
thread moves into a new network namespace, and what it starts from then on, threads and programs,
lives there too.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

ADDRESSES = ("127.0.0.1", "127.0.0.2")
THIRD_ADDRESS = "127.0.0.3"

_CLONE_NEWNET = 0x40000000  # sched.h
_SIOCSIFFLAGS, _SIOCSIFADDR = 0x8914, 0x8916  # netdevice(7)
_IFF_UP = 1


class NoLoopbackError(Exception):
    """This process may not make a network namespace; the message says why and what to do."""


@contextmanager
def private_loopback() -> Iterator[None]:
    """Run in a network namespace in which the addresses exist and nothing else does."""
    libc = ctypes.CDLL(None, use_errno=True)
    with open("/proc/thread-self/ns/net") as outside:  # noqa: PTH123  (its descriptor is wanted)
        if libc.unshare(_CLONE_NEWNET) != 0:
            reason = os.strerror(ctypes.get_errno())
            msg = f"no network namespace: {reason}; run as root, or under `unshare -rn`"
            raise NoLoopbackError(msg)
        try:
            _bring_up_loopback()
            yield
        finally:
            libc.setns(outside.fileno(), _CLONE_NEWNET)


def _bring_up_loopback() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        flags = struct.pack("16sH22x", b"lo", _IFF_UP)
        fcntl.ioctl(control, _SIOCSIFFLAGS, flags)
        for alias, address in ((b"lo:1", ADDRESSES[1]), (b"lo:2", THIRD_ADDRESS)):
            request = struct.pack("16sH2x4s16x", alias, socket.AF_INET, socket.inet_aton(address))
            fcntl.ioctl(control, _SIOCSIFADDR, request)
