"""A fleet: many processes that each hold many worlds, and one directory of all, in the keys of a bus.

Theory of operation. Each process keeps a view of all entries (`server.worlds.fleet_entries`). A process owns a world if
it has its lease (`server.worlds.lease`), and the world's entry names it. It changes the entries of its own worlds; each
change is a compare-and-set, and a world does not tick before its entry is written (`owns`). The process with the lowest
identifier *leads*: it removes leases that have run out, gives the worlds of such processes to others, and removes
the entries of those without data that nobody comes back to. Two that lead at once do no harm: of two changes of an
entry, one is refused.

This module has no clock and no bus. `requests` has what is to be asked; `answered` takes the results, `news` takes the
changes of the keys.
"""

from collections import Counter
from collections.abc import Callable, Mapping

from server.worlds.fleet_entries import WORLDS_MAX, EntryError, ProcessEntry, WorldEntry, packed, process_of, world_of
from server.worlds.fleet_view import GIVEN_S, Failed, FleetView, Known, Local, Mine, Result, Seen, Value
from server.worlds.lease import LEASE_S, Lease, Request

FREE_S = 30.0
"""Seconds after which the entry of a world without data and without an owner is removed."""
SWEEP_S = 0.5
"""Seconds between two looks at all entries."""
ERRANDS_MAX = 32
"""Maximum number of changes of other processes' entries that wait for an answer."""


class Fleet(FleetView):
    """This process and its view of the fleet.

    Args:
        name: name of the fleet.
        url: address of this process for clients.
        local: its worlds.
        token: returns a new random text of small letters and digits.
    """

    def __init__(self, name: str, url: str, local: Local, token: Callable[[], str]) -> None:
        super().__init__(name, url, local, Lease(token()[:8], token()))
        self._token = token
        self.wanted: dict[str, float] = {}
        """Names of worlds that clients of this process wait for, and when they asked last."""
        self.counts = Counter[str]()
        """Numbers of what became of entries and worlds."""
        self.requests: list[Request] = []
        """Requests to be sent."""
        self._errands: dict[str, WorldEntry | None] = {}
        self._gone: dict[str, None] = {}
        self._removed: dict[str, int] = {}
        self._spoiled: dict[str, tuple[float, int]] = {}
        self._orphans: dict[str, float] = {}
        self._number = 0
        self._swept_at = float("-inf")
        self._reported: object = None

    # -- what the process does ---------------------------------------------------------------------------------

    def claim(self, name: str, entry: WorldEntry) -> None:
        """Adds a world that has begun here. It does not tick before its entry is written."""
        self.mine[name] = Mine(entry._replace(owner=self.me), None, 0, running=True)

    def give(self, name: str, process: str, entry: WorldEntry) -> None:
        """Makes a world at another process."""
        self._given[name] = self.now + GIVEN_S, process, entry.kind
        self._placing[name] = entry._replace(owner=process)

    def want(self, name: str) -> None:
        """Notes that a client waits for a world."""
        self.wanted[name] = self.now
        if name not in self.worlds and name not in self.mine:
            self._ask("get", self._world_key(name))

    def ready(self, name: str, folder: str, revision: int) -> None:
        """Takes the directory with the data of a world that this process takes over (`Local.take`)."""
        mine = self.mine.get(name)
        if mine is not None and mine.written is not None and not mine.running and mine.revision == revision:
            mine.desired = mine.written._replace(owner=self.me, folder=folder, clean=False, asleep=False)
            self._begin(name, mine)

    def update(self, name: str, properties: Mapping[str, str | int | bool]) -> None:
        """Takes the present properties of a world."""
        mine = self.mine.get(name)
        if mine is not None and mine.running and mine.desired is not None and mine.desired.properties != properties:
            mine.desired = mine.desired._replace(properties=dict(properties))

    def release(self, name: str, *, asleep: bool) -> None:
        """Gives a world up whose data are saved and closed. Another process begins it; `asleep`: once a player comes.

        The entry of one without data is removed.
        """
        mine = self.mine.get(name)
        if mine is None:
            return
        base = mine.desired or mine.written
        if base is None or not (base.folder or base.stays):
            mine.ended = True
        else:
            mine.desired = base._replace(owner="", clean=mine.running or base.clean, asleep=asleep)
        mine.running = False

    def end(self, name: str) -> None:
        """Removes the entry of a world that has ended."""
        mine = self.mine.get(name)
        if mine is not None:
            mine.ended = True

    def leave(self) -> None:
        """Removes the lease, because the process ends. Its worlds must have been released."""
        if self._lease.revision:
            self._ask("delete", self._process_key(self.me), revision=self._lease.revision)
        self._lease.lost = True

    @property
    def busy(self) -> bool:
        """Whether entries of this process are to be changed."""
        return bool(self._open or any(mine.ended or mine.desired != mine.written for mine in self.mine.values()))

    # -- what comes in -----------------------------------------------------------------------------------------

    def tick(self, now: float) -> None:
        """Does what is due. Call it about ten times per second.

        Args:
            now: time in seconds, of a clock that goes on while the process is suspended.
        """
        self.now = now
        if self._lease.lost:
            self._rejoin()
        self._renew()
        if not self.holds(now):
            return
        for name in tuple(self.mine):
            self._write(name)
        for name, entry in self._placing.items():
            self._ask("put", self._world_key(name), packed(entry))
        if now - self._swept_at >= SWEEP_S:
            self._swept_at = now
            self._sweep()

    def news(self, key: str, found: Value | None, now: float) -> None:
        """Takes the value of a key that has changed; None: it has none."""
        self.now = max(now, self.now)
        kind, _, name = key.removeprefix(self.prefix).partition(".")
        if kind == "process" and name != self.me:
            self._seen(name, found)
        elif kind == "world":
            known = self.worlds.get(name)
            if found is not None and found.revision <= max(known.revision if known else 0, self._removed.get(name, 0)):
                return
            if found is None and name in self.mine:  # it may have been written since
                self._ask("get", key)
                return
            self._found(name, found)

    def answered(self, request: Request, result: Result, now: float) -> None:
        """Takes the result of a request."""
        self.now = max(now, self.now)
        key = request.key
        if self._open.get(key) != request:
            return  # it belongs to a lease that was lost
        del self._open[key]
        kind, _, name = key.removeprefix(self.prefix).partition(".")
        if kind == "process":
            self._answered_process(name, request, result)
        else:
            self._answered_world(name, request, result)

    # -- the lease ---------------------------------------------------------------------------------------------

    def _renew(self) -> None:
        """Renews the lease if it is time to."""
        lease, key = self._lease, self._process_key(self.me)
        if key in self._open:
            return
        if not lease.due(self.now, changed=True):
            return
        draining, load, room, figures = self._local.report()
        report = (draining, load, dict(room), {name: each._replace(age_s=0.0) for name, each in figures.items()})
        if lease.due(self.now, report != self._reported):
            self._reported = report
            beat = lease.sending(self.now)
            entry = ProcessEntry(lease.nonce, beat, self.url, draining, load, room, figures)
            self._ask("put", key, packed(entry), lease.revision)

    def _answered_process(self, name: str, request: Request, result: Result) -> None:
        lease = self._lease
        if name != self.me:  # one whose lease has run out
            if request.what == "delete" and result is None:
                self.counts["leases_removed"] += 1
                self._seen(name, None)
            elif request.what == "delete":
                self._ask("get", request.key)
            elif isinstance(result, Value) or result is None:
                self._seen(name, result)
        elif request.what == "put" and isinstance(result, int):
            lease.renewed(process_of(request.value).beat, result, self.now)
        elif request.what == "get" and (isinstance(result, Value) or result is None):
            try:
                entry = None if result is None else process_of(result.value)
                revision = 0 if result is None else result.revision
                lease.found(entry and entry.beat, "" if entry is None else entry.nonce, revision, self.now)
            except EntryError:
                lease.lost = True
        elif request.what != "delete":
            self._ask("get", request.key)

    def _rejoin(self) -> None:
        """Leaves all worlds, because the lease is lost, and begins anew as another process."""
        self.counts["leases_lost"] += 1
        for name in tuple(self.mine):
            self._lose(name)
        self._gone[self.me] = None
        self._lease = Lease(self._token()[:8], self._token())
        self._open.clear()
        self._errands.clear()
        self.requests.clear()
        self._reported = None

    # -- the worlds of this process ----------------------------------------------------------------------------

    def _write(self, name: str) -> None:
        """Changes the entry of a world of this process if it has to."""
        mine, key = self.mine[name], self._world_key(name)
        if mine.ended:
            if mine.revision:
                self._ask("delete", key, revision=mine.revision)
            elif key not in self._open:
                del self.mine[name]
        elif mine.desired is not None and mine.desired != mine.written:
            self._ask("put", key, packed(mine.desired), mine.revision)

    def _lose(self, name: str) -> None:
        """Forgets a world that this process does not own any more."""
        mine = self.mine.pop(name)
        if mine.running and not mine.ended:
            self.counts["worlds_lost"] += 1
            self._local.lose(name)

    def _answered_world(self, name: str, request: Request, result: Result) -> None:
        self._errands.pop(name, None)
        if request.what == "put" and isinstance(result, int):
            self._placing.pop(name, None)
            self._found(name, Value(request.value, result))
        elif request.what == "delete" and result is None:
            self._removed[name] = request.revision
            if len(self._removed) > WORLDS_MAX:
                del self._removed[next(iter(self._removed))]
            if name in self.mine and self.mine[name].ended:
                del self.mine[name]
            self._found(name, None)
        elif isinstance(result, Failed):
            if request.what != "get" or name in self.mine:
                self._ask("get", request.key)
        elif isinstance(result, Value) or result is None:
            if result is not None:
                self._placing.pop(name, None)
            self._found(name, result)

    def _found(self, name: str, found: Value | None) -> None:
        """Takes what the entry of a world has now."""
        entry = None
        if found is not None:
            try:
                entry = world_of(found.value)
            except EntryError:
                self.counts["malformed"] += 1
        if found is None or entry is None:
            self.worlds.pop(name, None)
            self._orphans.pop(name, None)
        elif name in self.worlds or len(self.worlds) < WORLDS_MAX:
            self.worlds[name] = Known(entry, found.revision)
            if entry.owner in self.processes or entry.owner == self.me:
                self._orphans.pop(name, None)
        mine = self.mine.get(name)
        if mine is None:
            if entry is not None and found is not None and entry.owner == self.me:
                self.mine[name] = Mine(None, entry, found.revision)
                self._local.take(name, entry, found.revision)
            return
        mine.revision = 0 if found is None else found.revision
        if (found is None and mine.ended) or (entry is None and not mine.running):
            del self.mine[name]
        elif entry is None:  # removed or spoiled: it is written again
            mine.written = None
        elif entry.owner == self.me:
            mine.written = entry
            self._begin(name, mine)
        elif entry == mine.desired:  # it was released
            del self.mine[name]
        else:
            self._lose(name)

    def _begin(self, name: str, mine: Mine) -> None:
        """Begins a world that was taken over, once its entry is written."""
        if mine.running or mine.ended or mine.desired is None or mine.desired != mine.written or not mine.desired.owner:
            return
        if not self.holds(self.now):  # the process was suspended; `_sweep` begins it, if it is still its world
            return
        mine.running = True
        if not self._local.begin(name, mine.desired):
            self.counts["worlds_failed"] += 1
            self.release(name, asleep=True)

    # -- the worlds of others ----------------------------------------------------------------------------------

    def _seen(self, name: str, found: Value | None) -> None:
        """Takes what the entry of another process has now."""
        known = self.processes.get(name)
        if found is None:
            if self._spoiled.pop(name, None) or known is not None:
                self.processes.pop(name, None)
                self._gone[name] = None
                if len(self._gone) > WORLDS_MAX:
                    del self._gone[next(iter(self._gone))]
            return
        if name in self._gone or (known is not None and found.revision <= known.revision):
            return
        try:
            entry = process_of(found.value)
        except EntryError:
            self.counts["malformed"] += 1
            self.processes.pop(name, None)
            if len(self._spoiled) < ERRANDS_MAX:
                self._spoiled[name] = self.now, found.revision
            return
        self._spoiled.pop(name, None)
        if known is not None or len(self.processes) < WORLDS_MAX:
            self.processes[name] = Seen(entry, found.revision, self.now)

    def _sweep(self) -> None:
        """Looks after entries whose process is gone."""
        self.wanted = {name: at for name, at in self.wanted.items() if self.now - at < LEASE_S}
        steady = self.now - self._lease.since >= LEASE_S
        leads = not any(process < self.me for process, _ in self.others())
        if leads and steady:  # others have had the time to renew theirs since the bus answers
            for process, seen in self.processes.items():
                if not self.alive(process):
                    self._ask("delete", self._process_key(process), revision=seen.revision)
            for process, (since, revision) in self._spoiled.items():
                if self.now - since >= LEASE_S:
                    self._ask("delete", self._process_key(process), revision=revision)
        for name, mine in tuple(self.mine.items()):
            self._begin(name, mine)
        for name, known in tuple(self.worlds.items()):
            owner = known.entry.owner
            if owner == self.me and name not in self.mine:
                self._found(name, Value(packed(known.entry), known.revision))
            elif owner != self.me and owner not in self.processes:
                since = self._orphans.setdefault(name, self.now)
                sure = owner == "" or owner in self._gone or self.now - since >= LEASE_S
                if sure and name not in self.mine and len(self._errands) < ERRANDS_MAX:
                    self._adopt(name, known, since, leads)

    def _adopt(self, name: str, known: Known, since: float, leads: bool) -> None:
        """Gives a world without an owner to a process, or removes its entry."""
        entry, wanted = known.entry, name in self.wanted
        if wanted or (leads and not entry.asleep and (entry.folder or entry.stays)):
            target = self.place(entry.kind)
            if target:
                given = entry._replace(owner=target, asleep=False)
                self._errands[name] = given
                if target != self.me:
                    self._given[name] = self.now + GIVEN_S, target, entry.kind
                self._ask("put", self._world_key(name), packed(given), known.revision)
        elif leads and not entry.folder and self.now - since >= FREE_S:
            self._errands[name] = None
            self._ask("delete", self._world_key(name), revision=known.revision)

    # -- requests ----------------------------------------------------------------------------------------------

    def _ask(self, what: str, key: str, value: bytes = b"", revision: int = 0) -> None:
        """Sends a request, unless one about the key has no answer yet."""
        if key not in self._open:
            self._number += 1
            request = self._open[key] = Request(self._number, what, key, value, revision)
            self.requests.append(request)
