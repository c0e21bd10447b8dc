"""A diagnosis of a running client for its developer: a verdict in one word, its reason, and what to do about it."""

from typing import NamedTuple

from client_sdk.stats import Stats

MATCHED, LATE, OTHERS, DIVERGING = "matched", "late inputs", "others", "diverging"
"""Verdicts: predictions are right; inputs arrive too late; others or the rules interfere; both sides compute different
results."""
NONDETERMINISM = "nondeterminism"
"""Cause of a correction that shows a fault of the game's code or of ours (`client_sdk.prediction.prediction`)."""
ACTS_MAX = 10
"""Corrections per minute by acts of the rules from which a warning is given."""
LATE_SHARE_MAX = 0.01
"""Share of late inputs in the last 5 s from which the verdict is `LATE`."""
QUIET_S = 10.0
"""Seconds of play without a single input that is not neutral from which a warning is given."""
WAITING_MAX = 1000
"""Number of events that the program has not taken from which a warning is given."""
ADVICE = {
    MATCHED: "Nothing to do.",
    LATE: "The connection stalls. The client sends earlier by itself; set_input_delay(2) makes it smoother.",
    OTHERS: "Other players or the rules changed what this client predicted, as happens where players meet. "
    "What the rules often do to this player can become a behaviour, which is predicted.",
    DIVERGING: "A behaviour reads more than its state and inputs (a clock, random, the order of a set), or a copy is "
    "damaged. sovereign_netcode.playtest.check_behaviours finds the behaviour in a test of the game.",
}
"""Advice for each verdict."""


class Diagnosis(NamedTuple):
    """The state of a client's prediction in words.

    `verdict` is `MATCHED`, `LATE`, `OTHERS` or `DIVERGING`, for the last minute. `reason` says why, and `advice` what
    to do. `warnings` name mistakes in how the program uses the client.
    """

    verdict: str
    reason: str
    advice: str
    warnings: list[str]


class Use(NamedTuple):
    """The use that a program makes of its client.

    `waiting` is the number of events that it has not taken, `playing_s` the time of play in seconds, `steered` whether
    any input was set, `predicts` whether its scene has behaviours.
    """

    waiting: int
    playing_s: float
    steered: bool
    predicts: bool


def diagnosis(stats: Stats, use: Use) -> Diagnosis:
    """Returns the diagnosis of a client from its statistics and its use."""
    lately = stats.corrections_lately
    late, total = lately.get("late input", 0), sum(lately.values())
    others = total - late - lately.get(NONDETERMINISM, 0)
    share = stats.late_share_lately
    if stats.divergences or NONDETERMINISM in lately:
        verdict, reason = DIVERGING, f"{stats.divergences} times this client computed another result than the server"
    elif share > LATE_SHARE_MAX or late > others:
        verdict, reason = (
            LATE,
            f"{100 * share:.1f} % of the inputs of the last 5 s were late, {late} corrections a minute",
        )
    elif others:
        causes = ", ".join(f"{count} by {cause}" for cause, count in lately.items() if cause != "late input")
        verdict, reason = OTHERS, f"corrections in the last minute: {causes}"
    else:
        verdict, reason = MATCHED, "no correction in the last minute"
    return Diagnosis(verdict, reason, ADVICE[verdict], _warnings(stats, use, lately))


def _warnings(stats: Stats, use: Use, lately: dict[str, int]) -> list[str]:
    """Returns the mistakes in how a program uses its client."""
    found = []
    if use.playing_s > QUIET_S and not use.steered:
        found.append("No input was set since the player joined: call set_input in each frame.")
    if use.waiting > WAITING_MAX:
        found.append(f"{use.waiting} events wait: take them with poll() in each frame.")
    if stats.resyncs > max(use.playing_s / QUIET_S, 3):
        found.append(f"Prediction started again {stats.resyncs} times: call update() at least once per tick.")
    acts = lately.get("server act", 0)
    if acts > ACTS_MAX:
        what = "push() and templates" if use.predicts else "a behaviour"
        found.append(f"The rules moved this player {acts} times in the last minute: with {what} it would be predicted.")
    if stats.kernel == "plain":
        found.append("The physics runs in plain Python: no prebuilt kernel for this platform, and no Numba.")
    return found
