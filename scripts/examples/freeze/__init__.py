"""The former name of `sovereign_netcode.examples.freeze`."""

from sovereign_netcode.examples.freeze import *  # noqa: F403
