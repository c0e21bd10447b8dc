"""Copies of a scene with one change, as rules make them in `prepare`."""

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, Self

from shared.behaviours import BehaviourEntry, entries_of
from shared.block_kind import BlockKind
from shared.tables import made
from shared.template import Template


class SceneCopies:
    """The part of `shared.scene.Scene` that makes copies. Each method raises `SceneError` if a value is not valid."""

    if TYPE_CHECKING:
        templates: tuple[Template, ...]
        player: str
        buttons: tuple[str, ...]
        aim: bool
        kinds: tuple[BlockKind, ...]
        behaviours: tuple[BehaviourEntry, ...]

        def template(self, name: object, at: str = "template") -> int: ...

    def with_template(self, name: str, like: str | None = None, **changes: Any) -> Self:
        """Returns a copy of the scene with one more template.

        Args:
            name: name of the new template.
            like: name of the template to copy; None: the players' template.
            changes: fields of the new template that differ, by name.

        Raises:
            SceneError: there is no template `like`, a field is unknown or out of range, or the name is in use.
        """
        base = self.templates[self.template(self.player if like is None else like, "like")]
        return self._with(templates=(*self.templates, _changed(base, {**changes, "name": name})))

    def with_changes(self, template: str, **changes: Any) -> Self:
        """Returns a copy of the scene in which a template has other values.

        Args:
            template: name of the template.
            changes: the fields of the template that change, by name.

        Raises:
            SceneError: there is no such template, or a field is unknown or out of range.
        """
        kind = self.template(template)
        new = _changed(self.templates[kind], changes)
        return self._with(templates=(*self.templates[:kind], new, *self.templates[kind + 1 :]))

    def with_buttons(self, *names: str, aim: bool | None = None) -> Self:
        """Returns a copy of the scene with further buttons.

        Args:
            names: names of the new buttons.
            aim: whether players send an aim; None: as before.

        Raises:
            SceneError: a name is not valid or in use, or there are too many buttons.
        """
        return self._with(buttons=(*self.buttons, *names), aim=self.aim if aim is None else aim)

    def with_kind(self, name: str, number: int | None = None, *, solid: bool = True) -> Self:
        """Returns a copy of the scene with one more kind of blocks; `BlockKind` describes the arguments."""
        return self._with(kinds=(*self.kinds, BlockKind(name, number, solid)))

    def with_behaviours(self, classes: Iterable[object]) -> Self:
        """Returns a copy of the scene with further behaviours.

        Raises:
            SceneError: a class or one of its values is not valid, or two behaviours have one template or name.
        """
        added = entries_of(classes)
        return self._with(behaviours=(*self.behaviours, *added)) if added else self

    def _with(self, **changes: Any) -> Self:
        return replace(self, **changes)  # type: ignore[type-var]  # `Scene` is a dataclass


def _changed(base: Template, changes: dict[str, Any]) -> Template:
    return made(Template, {**{f.name: getattr(base, f.name) for f in fields(Template)}, **changes}, "templates")
