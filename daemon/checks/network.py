"""GigE Vision cameras: the interface they are reached through, and the kernel's room for images."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping
from ipaddress import IPv4Address

from daemon.checks import host
from daemon.checks.finding import Finding, unless
from daemon.checks.usb import frame_bytes
from daemon.config.reading import Config
from drivers.protocols import Role

GIGABIT_MBIT_S = 1000
JUMBO_BYTES = 9000
_LOOPBACK = IPv4Address("127.0.0.0"), IPv4Address("255.0.0.0")


def check_network(config: Config, addresses: Mapping[Role, str]) -> Iterator[Finding]:
    """Look at the way to each GigE camera that was found, by its address."""
    for role, address in addresses.items():
        yield from _way(role, address)
    if addresses:
        yield _receive_buffer(max(frame_bytes(config, role) for role in addresses))


def _way(role: Role, address: str) -> Iterator[Finding]:
    interface = interface_to(IPv4Address(address))
    if interface is None:
        cure = "give an interface an address of the camera's network, or the camera one of its own"
        yield Finding(f"{role} link", "warning", f"{address}: no route: {cure}")
        return
    files = host.path("sys/class/net") / interface
    mbit_s = host.number(files / "speed")
    if mbit_s is not None and mbit_s > 0:
        text = f"{address} through {interface}, {mbit_s} Mbit/s"
        cure = f"use a gigabit port and cable (Cat 5e or better); see ethtool {interface}"
        yield unless(mbit_s >= GIGABIT_MBIT_S, f"{role} link", text, cure)
    else:  # the kernel does not tell it of every interface
        yield Finding(f"{role} link", "ok", f"{address} through {interface}")
    mtu_bytes = host.number(files / "mtu")
    if mtu_bytes is not None:
        text = f"{interface} carries {mtu_bytes} bytes a packet"
        cure = (
            "six times as many packets to lose; if camera and switch can,"
            f" ip link set dev {interface} mtu {JUMBO_BYTES}, and the same in its settings"
        )
        yield unless(mtu_bytes >= JUMBO_BYTES, f"{role} packets", text, cure)


def interface_to(address: IPv4Address) -> str | None:
    """Give the interface that the kernel's table routes an address through; None: no way."""
    ways: list[tuple[int, str]] = []
    if int(address) & int(_LOOPBACK[1]) == int(_LOOPBACK[0]):
        ways.append((int(_LOOPBACK[1]), "lo"))
    table = host.text(host.path("proc/net/route")) or ""
    for line in table.splitlines()[1:]:
        cells = line.split()
        destination, mask = _host_order(cells[1]), _host_order(cells[7])
        if int(address) & mask == destination:
            ways.append((mask, cells[0]))
    return max(ways)[1] if ways else None


def _host_order(cell: str) -> int:
    """Read an address of the table: the network's bytes, printed as a number of this machine's."""
    return socket.ntohl(int(cell, 16))


def _receive_buffer(image_bytes: int) -> Finding:
    granted = host.number(host.path("proc/sys/net/core/rmem_max"))
    if granted is None:
        return Finding("receive buffer", "warning", "the kernel does not tell net.core.rmem_max")
    text = f"up to {granted / 1e6:.3g} MB a socket, an image has {image_bytes / 1e6:.3g} MB"
    cure = (
        "sysctl net.core.rmem_max=33554432; to keep it, echo net.core.rmem_max=33554432"
        " > /etc/sysctl.d/60-dcam.conf"
    )
    return unless(granted >= image_bytes, "receive buffer", text, cure)
