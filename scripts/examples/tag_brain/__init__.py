"""The former name of `sovereign_netcode.examples.tag_brain`."""

from sovereign_netcode.examples.tag_brain import *  # noqa: F403
