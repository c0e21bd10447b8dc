"""The watchers of a game: they find contacts and visits of zones, and report them by the hooks of the rules.

A watcher whose hooks the rules do not override costs nothing.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from server.game_api.block_contacts import BlockContacts
from server.game_api.contacts import Contacts
from server.game_api.zones import Zones
from server.rules import Rules, overrides
from shared.layout import ID
from shared.world import World

Call = Callable[..., Any]
"""Function that calls a hook with its arguments, and survives what the hook raises."""


class Watchers:
    """The watchers of one game.

    Args:
        world: the world.
        rules: the rules, whose hooks are called.
        zones: the zones.
        goes_on: whether the game is restored, so that the present contacts were reported before the restart.
    """

    def __init__(self, world: World, rules: Rules, zones: Zones, *, goes_on: bool) -> None:
        self._world, self._rules, self._zones = world, rules, zones
        self.contacts = Contacts(world, goes_on=goes_on)
        self._reports_contacts = overrides(rules, "on_contact") or overrides(rules, "on_contact_end")
        self._blocks = BlockContacts(world, goes_on=goes_on) if overrides(rules, "on_block_contact") else None
        self._reports_visits = overrides(rules, "on_enter") or overrides(rules, "on_exit")
        self.idle = not (self._reports_contacts or self._reports_visits or self._blocks is not None)
        """Whether the rules have none of the hooks."""
        self._stepped = np.zeros(0, np.int64)

    @property
    def _active(self) -> bool:
        return self._reports_contacts or self._blocks is not None or (self._reports_visits and bool(self._zones))

    def stepped(self) -> None:
        """Takes note of the entities that a step has changed. The world forgets them at its next change."""
        if self._active:
            self._stepped = self._world.changed[:, ID]

    def report(self, call: Call) -> None:
        """Calls the hooks for what has begun and ended since the last call, in the latest step or by the rules."""
        if not self._active:
            return
        changed = np.union1d(self._stepped, self._world.changed[:, ID])
        if self._reports_contacts:
            ended, begun = self.contacts.update(changed)
            for pair in ended:
                call(self._rules.on_contact_end, *pair)
            for pair in begun:
                if pair[0] in self._world and pair[1] in self._world:
                    call(self._rules.on_contact, *pair)
                    self.contacts.reported(pair)
                else:
                    self.contacts.forget(pair)
        for entity, block in self._blocks.update(changed) if self._blocks is not None else ():
            if entity in self._world:
                call(self._rules.on_block_contact, entity, *block)
        if self._reports_visits and self._zones:
            left, entered = self._zones.update(changed)
            for visit in left:
                call(self._rules.on_exit, *visit)
            for zone, entity in entered:
                if entity in self._world:
                    call(self._rules.on_enter, zone, entity)
                else:
                    self._zones.forget((zone, entity))
