"""What may stand in the config as a head's port: a local one, or one behind the network."""

from __future__ import annotations

from urllib.parse import urlsplit

NETWORK_SCHEMES = ("socket", "rfc2217")
"""pyserial's URLs: the bytes alone over TCP; or a serial server that also sets the baud rate."""
URL_OPTIONS = {"socket": set[str](), "rfc2217": {"ign_set_control"}}


def is_network(port: str) -> bool:
    """Whether the port is reached over the network."""
    return "://" in port


def port_problem(port: str) -> str | None:
    """Say what is wrong with a port's name, and what may be there; None if nothing is."""
    if not is_network(port):
        return None
    may_be = "use /dev/..., socket://HOST:PORT or rfc2217://HOST:PORT"
    parts = urlsplit(port)
    if parts.scheme not in NETWORK_SCHEMES:
        return f"has no way to a head that dcam knows; {may_be}"
    try:
        number = parts.port
    except ValueError:
        number = None
    if not parts.hostname or not number:
        return f"needs host and port number, as {parts.scheme}://192.168.1.20:4000"
    options = set(filter(None, parts.query.split("&"))) - URL_OPTIONS[parts.scheme]
    if options or parts.path.strip("/") or parts.fragment or parts.username:
        return f"says more than host and port number; {may_be}"
    return None
