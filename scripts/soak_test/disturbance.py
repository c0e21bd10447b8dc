"""Kills, stalls and attacks of a soak test, planned from a seed."""

import asyncio
import dataclasses
import json
import random
import signal
import sys
import time
from collections import Counter

from scripts.environment import ROOT
from scripts.soak_test.server_process import END_S, Life
from sovereign_netcode.stderr import Stderr

QUIET_SHARE = 0.4
"""Share of the time, at its end, in which the server is not killed."""
ABUSE = {
    "nothing": 20,
    "half_a_request": 10,
    "slow_loris": 10,
    "never_reads": 5,
    "one_byte_a_second": 5,
    "mid_frame": 4,
    "rubbish": 4,
    "flood": 1,
}
"""Number of hostile peers for each attack (`scripts.loadgen.hostile`)."""
CONNECTS_PER_S = 200
STALL_S = 1.0, 5.0
"""Shortest and longest time, in seconds, for which the server is suspended."""


@dataclasses.dataclass
class Course:
    """The plan of a soak test: kills, stalls and attacks with their times."""

    seconds: float
    rng: random.Random

    def plan(self) -> list[tuple[float, str]]:
        """Returns events with their times, in seconds from the start: at least one of each kind.

        There are no kills in the quiet part.
        """
        events = []
        for what, every, share in (("kill", 90.0, 1 - QUIET_SHARE), ("stall", 75.0, 0.9), ("abuse", 60.0, 0.8)):
            n = max(1, int(self.seconds * share / every))
            gap = self.seconds * share / n
            events += [(gap * (i + self.rng.uniform(0.3, 0.9)), what) for i in range(n)]
        return sorted(events)


async def abuse(port: int, seed: int, seconds: float, made: Counter[str], errors: list[str]) -> None:
    """Attacks the server for `seconds`. Adds the attacks to `made`, and the failures of the attacker to `errors`."""
    order = {"port": port, "seed": seed, "peers": ABUSE, "connects_per_s": CONNECTS_PER_S}
    complaints = Stderr()
    try:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "scripts.loadgen.hostile", json.dumps(order)),
            cwd=ROOT,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=complaints.pipe,
        )
    finally:
        complaints.started()
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        await asyncio.sleep(seconds)
        process.stdin.close()
        told = json.loads(await asyncio.wait_for(process.stdout.read(), END_S) or b"{}")
        made.update(told.get("made", {}))
        code = await asyncio.wait_for(process.wait(), END_S)
        errors += [f"hostile: {error}" for error in told.get("failed", [f"it died: {complaints.cause(code)}"])]
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def disturb(life: Life, course: Course, counts: Counter[str], errors: list[str]) -> None:
    """Carries out the plan. An attack runs while the next events happen."""
    begun = time.monotonic()
    length_s = min(20.0, course.seconds / 4)
    async with asyncio.TaskGroup() as group:
        for at, what in course.plan():
            await asyncio.sleep(max(0.0, begun + at - time.monotonic()))
            counts[what] += 1
            assert life.process is not None
            if what == "kill":
                await life.end(signal.SIGKILL)
                await life.start()
            elif what == "stall":
                life.process.send_signal(signal.SIGSTOP)
                await asyncio.sleep(course.rng.uniform(*STALL_S))
                life.process.send_signal(signal.SIGCONT)
            else:
                group.create_task(abuse(life.port, counts[what], length_s, counts, errors))
        await asyncio.sleep(max(0.0, begun + course.seconds - time.monotonic()))
