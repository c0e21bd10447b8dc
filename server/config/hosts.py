"""Host names and addresses: those of this machine, and those that count as one peer."""

import ipaddress

ANY = "*"
"""The entry of a list of origins or host names that allows all."""
NO_ADDRESS = ipaddress.IPv6Address("2000::")
"""Stands for a text that is no address, such as the address of a peer that has already disconnected."""


def is_loopback(address: str) -> bool:
    """Returns whether an address is one of this machine's loopback addresses."""
    return parsed(address).is_loopback


def network_of(address: str) -> str:
    """Returns the name by which connections are counted: an IPv4 address, or the /64 network of an IPv6 address.

    One customer of a provider usually has a whole /64 network.
    """
    found = parsed(address)
    return str(found) if found.version == 4 else str(int(found) >> 64)


def parsed(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """Returns the address in a text; `NO_ADDRESS` if it is none. An IPv4-mapped IPv6 address becomes IPv4."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return NO_ADDRESS
    return getattr(found, "ipv4_mapped", None) or found
