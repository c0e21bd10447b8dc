"""Behaviours: game code that the server and every client run alike, so that clients predict it.

    class Runner(Behaviour):
        templates = ("player",)
        stamina = field(bits=8, start=100)
        ready_at = field(bits=32)

        def turn(self, me: Body) -> None:
            if me.pressed("dash") and me.tick >= me.ready_at and me.stamina >= 20:
                me.velocity = (12.0, 0.0, 0.0)
                me.stamina -= 20
                me.ready_at = me.tick + 32

Theory of operation. A behaviour is a class that a game's rules and its clients import alike. It is bound to templates.
At the start of each tick, before the step, its `turn` is called for every entity of such a template that is active
(`shared.turns`). A turn reads and changes its entity through a `Body` (`shared.body`). The fields of a behaviour are
whole numbers that each of its entities has; they are part of the exact state. The same state and the same inputs must
lead to the same result everywhere, so a turn reads nothing else: no clock, no random numbers but `me.chance`, no order
of a set, no variable that a turn has changed.

A scene names its behaviours with a digest of their code (`BehaviourEntry`). A client passes its own classes; one that
is missing, or has another digest, is refused. Nothing is imported because a server names it.
"""

import hashlib
import inspect
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from types import CodeType
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

from shared.checks import SceneError, boolean, items, shown, text, whole

if TYPE_CHECKING:
    from shared.body import Body

BITS_MAX = 48
"""Greatest size of a field, in bits."""
FIELDS_MAX = 32
"""Limit of the fields of a behaviour."""
SPAWNS_MAX = 32
"""Limit of the entities that one entity has spawned and that exist at the same time."""
BEHAVIOURS_MAX = 32
"""Limit of the behaviours of a scene."""
NAME_MAX = 32
"""Longest name of a behaviour or a field, in characters."""


class BehaviourError(SceneError):
    """A scene needs behaviours that this program does not have, or has in another version."""


@dataclass(frozen=True)
class Field:
    """A whole number that each entity of a behaviour has. Make it with `field`.

    Within a turn, `me.NAME` reads and sets it. A value out of range raises `SceneError`.
    """

    bits: int
    start: int = 0
    signed: bool = False
    name: str = ""

    @property
    def low(self) -> int:
        """The lowest value."""
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        """The greatest value."""
        return (1 << (self.bits - self.signed)) - 1

    def __set_name__(self, owner: type, name: str) -> None:
        object.__setattr__(self, "name", text(name, "field", NAME_MAX))

    def checked(self, value: object) -> int:
        """Returns a value for the field after a check.

        Raises:
            SceneError: the value is not a whole number in the field's range.
        """
        return whole(value, self.name, self.low, self.high)


def field(bits: int, start: int = 0, *, signed: bool = False) -> Any:
    """Returns a field for the body of a behaviour's class.

    Args:
        bits: the size, 1 to 48 bits: the range is 0 to 2^bits - 1, or with `signed` -2^(bits-1) to 2^(bits-1) - 1.
        start: the value of a new entity.
        signed: whether the field has negative values.

    Raises:
        SceneError: a value is out of range.
    """
    made = Field(whole(bits, "field.bits", 1, BITS_MAX), 0, boolean(signed, "field.signed"))
    return Field(made.bits, whole(start, "field.start", made.low, made.high), made.signed)


class Behaviour:
    """The base class of behaviours. The module describes what a turn may do.

    One instance serves all entities of a world, so it must not keep anything of its own.
    """

    templates: tuple[str, ...] = ()
    """Names of the templates that the behaviour is bound to. An entity that changes from one of them to another keeps
    its fields."""
    spawns = 0
    """Number of entities that an entity of the behaviour may have spawned (`Body.spawn`) at the same time, 0 to 32."""
    always = False
    """Whether an entity has a turn in every tick, also while it stands still without an input: to notice what touches
    it, for example. It costs time for each entity, and no bytes."""

    def turn(self, me: "Body") -> None:
        """Is called once per tick and active entity, before the step."""
        raise NotImplementedError


@dataclass(frozen=True)
class BehaviourEntry:
    """A behaviour as a scene names it.

    Args:
        name: name of the class.
        templates: names of its templates.
        fields: its fields, in the order of the class.
        spawns: number of entities that one entity may have spawned at the same time.
        digest: digest of its code, in hexadecimal digits.
        code: the class; None: this program does not have it, or has not bound it (`bound`).

    Raises:
        SceneError: a value is not valid; the message names it.
    """

    name: str
    templates: tuple[str, ...]
    fields: tuple[Field, ...]
    spawns: int
    digest: str
    code: type[Behaviour] | None = dataclass_field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        at = f"behaviours.{text(self.name, 'behaviours.name', NAME_MAX)}"
        names = [text(name, f"{at}.templates", 64) for name in items(self.templates, f"{at}.templates")]
        if not names:
            raise SceneError(f"{at}.templates: must name at least one template")
        if len(self.fields) > FIELDS_MAX:
            raise SceneError(f"{at}: {len(self.fields)} fields; at most {FIELDS_MAX}")
        whole(self.spawns, f"{at}.spawns", 0, SPAWNS_MAX)
        text(self.digest, f"{at}.digest", 64)
        object.__setattr__(self, "templates", tuple(names))

    def to_table(self) -> dict[str, Any]:
        """Returns a table for `from_table`, of plain lists, texts and numbers."""
        return {
            "name": self.name,
            "templates": list(self.templates),
            "fields": [[each.name, each.bits, each.start, each.signed] for each in self.fields],
            "spawns": self.spawns,
            "digest": self.digest,
        }

    @classmethod
    def from_table(cls, table: object) -> "BehaviourEntry":
        """Returns the entry that a table describes, without the class.

        Raises:
            SceneError: a value is missing or not valid.
        """
        wanted = {"name", "templates", "fields", "spawns", "digest"}
        if not isinstance(table, Mapping) or set(table) != wanted:
            raise SceneError(f"behaviours = {shown(table)}: must be tables with {', '.join(sorted(wanted))}")
        fields = [_field_of(each) for each in items(table["fields"], "behaviours.fields")]
        templates = tuple(items(table["templates"], "behaviours.templates"))
        return cls(table["name"], templates, tuple(fields), table["spawns"], table["digest"])


def checked_entries(value: object) -> tuple[BehaviourEntry, ...]:
    """Returns the behaviours of a scene, given as entries or as their tables.

    Raises:
        SceneError: one of them is not valid, there are too many, or two have the same name.
    """
    entries = [
        each if isinstance(each, BehaviourEntry) else BehaviourEntry.from_table(each)
        for each in items(value, "behaviours")
    ]
    names = [entry.name for entry in entries]
    if len(entries) > BEHAVIOURS_MAX:
        raise SceneError(f"behaviours: {len(entries)} of them; at most {BEHAVIOURS_MAX}")
    if len(set(names)) < len(names):
        raise SceneError(f"behaviours: two have the same name ({', '.join(names)})")
    return tuple(entries)


def entry_of(code: object) -> BehaviourEntry:
    """Returns the entry of a behaviour's class.

    Raises:
        SceneError: it is not a class of a behaviour, or one of its values is not valid.
    """
    if not (isinstance(code, type) and issubclass(code, Behaviour)):
        raise SceneError(f"behaviours: {shown(code)} must be a subclass of `Behaviour`")
    name = code.__name__
    if code.turn is Behaviour.turn:
        raise SceneError(f"behaviours.{name}: has no method `turn`")
    templates: object = code.templates
    if isinstance(templates, str) or not isinstance(templates, Iterable):
        raise SceneError(f"behaviours.{name}.templates = {shown(templates)}: must be a tuple of names of templates")
    boolean(code.always, f"behaviours.{name}.always")
    fields = fields_of(code)
    taken = next((each.name for each in fields if each.name.startswith("_") or hasattr(_body(), each.name)), None)
    if taken is not None:
        raise SceneError(f"behaviours.{name}.{taken}: this name is taken; use another one")
    return BehaviourEntry(name, tuple(templates), fields, code.spawns, digest_of(code, fields), code)


def _body() -> "type[Body]":
    """Returns the class of the bodies, which reads this module itself."""
    from shared.body import Body

    return Body


def entries_of(classes: object) -> tuple[BehaviourEntry, ...]:
    """Returns the entries of several classes of behaviours.

    Raises:
        SceneError: `classes` is not a list of classes of behaviours, or two have the same name.
    """
    if isinstance(classes, type | str) or not isinstance(classes, Iterable):
        raise SceneError(f"behaviours = {shown(classes)}: must be a list of subclasses of `Behaviour`")
    found = tuple(map(entry_of, classes))
    names = [entry.name for entry in found]
    if len(set(names)) < len(names):
        raise SceneError(f"behaviours: two have the same name ({', '.join(names)})")
    return found


def fields_of(code: type[Behaviour]) -> tuple[Field, ...]:
    """Returns the fields of a class and its base classes, the oldest first."""
    found = {name: value for owner in reversed(code.__mro__) for name, value in vars(owner).items()}
    return tuple(value for value in found.values() if isinstance(value, Field))


def digest_of(code: type[Behaviour], fields: Iterable[Field]) -> str:
    """Returns a digest of the source of a class and its base classes, and of its fields: 16 hexadecimal digits.

    Comments, empty lines and the indentation of the whole class do not count. Functions outside of the class are not
    part of it.
    """
    digest = hashlib.blake2b(digest_size=8)
    for owner in code.__mro__:
        if owner not in (Behaviour, object):
            digest.update(_source(owner).encode())
    numbers = [(each.name, each.bits, each.start, each.signed) for each in fields]
    digest.update(repr((numbers, code.always)).encode())
    return digest.hexdigest()


def checked_classes(classes: object) -> tuple[type[Behaviour], ...]:
    """Returns the classes of behaviours that a program has passed.

    Raises:
        SceneError: one of them is not valid.
    """
    found = [entry.code for entry in entries_of(classes)]
    return tuple(each for each in found if each is not None)


def bound(entries: Iterable[BehaviourEntry], classes: Iterable[object]) -> tuple[BehaviourEntry, ...]:
    """Returns a scene's behaviours with the classes of this program.

    Raises:
        BehaviourError: a class is missing, or differs from the one that the scene names; the message names it.
        SceneError: a class is not valid.
    """
    mine = {each.name: each for each in entries_of(classes)}
    found = []
    for entry in entries:
        own = mine.get(entry.name)
        if own is None:
            raise BehaviourError(f"behaviours: the game needs the class {entry.name}; pass it as behaviours=[...]")
        if own != entry:
            raise BehaviourError(f"behaviours: the class {entry.name} differs from the server's")
        found.append(own)
    return tuple(found)


def _source(code: type) -> str:
    """Returns the source of a class without comments and empty lines; without a file, its compiled functions.

    It is read once, because the file may change while the program runs.
    """
    source = _SOURCES.get(code)
    if source is None:
        source = _SOURCES[code] = _read_source(code)
    return source


def _read_source(code: type) -> str:
    try:
        lines = textwrap.dedent(inspect.getsource(code)).splitlines()
    except (OSError, TypeError):  # made in an interactive session or by `exec`
        functions = [value for value in vars(code).values() if inspect.isfunction(value)]
        return repr([(each.__name__, _compiled(each.__code__)) for each in functions])
    return "\n".join(line.rstrip() for line in lines if line.strip() and not line.lstrip().startswith("#"))


def _compiled(code: CodeType) -> tuple[object, ...]:
    """Returns what a compiled function consists of, without addresses and places in files."""
    consts = [_compiled(each) if isinstance(each, CodeType) else each for each in code.co_consts]
    return code.co_code, code.co_names, code.co_varnames, consts


_SOURCES: WeakKeyDictionary[type, str] = WeakKeyDictionary()
"""Sources of classes as they were when first asked for."""


def _field_of(value: object) -> Field:
    parts = items(value, "behaviours.fields")
    if len(parts) != 4:
        raise SceneError(f"behaviours.fields = {shown(value)}: must be name, bits, start, signed")
    name, bits, start, signed = parts
    made: Field = field(bits, start, signed=signed)
    return Field(made.bits, made.start, made.signed, text(name, "behaviours.fields.name", NAME_MAX))
