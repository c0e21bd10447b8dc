"""The former name of `sovereign_netcode.examples.tag`."""

from sovereign_netcode.examples.tag import *  # noqa: F403
