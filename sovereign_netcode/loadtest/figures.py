"""The figures of a load test: turns raw counts into figures, a table and a verdict in words. No I/O happens here."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from client_sdk.prediction.prediction import NONDETERMINISM
from server.observability.histogram import between
from shared.messages import MALFORMED

SNAPSHOTS_SHARE_MIN = 0.95
LATE_SHARE_MAX = 0.01
PACE_MIN = 0.98
BOTS_CPU_SHARE_MAX = 0.9
"""Greatest share of one core that a process of bots may use. Above it, the test measures the bots, not the server."""
MEMORY_MB_MAX = 5.0
MEMORY_SETTLED_S = 10
LATENESS = "tick_lateness_counts"
"""Key in `/stats` of the histogram of tick lateness."""
UNKNOWN = "not reported"

Figures = dict[str, Any]


class Judgement(NamedTuple):
    """One sentence of the verdict."""

    good: bool
    text: str


def quantiles(values: Sequence[float]) -> dict[str, float]:
    """Returns p50, p99 and max; zeros if there are no values."""
    if not values:
        return {"p50": 0.0, "p99": 0.0, "max": 0.0}
    ordered = sorted(values)
    last = len(ordered) - 1
    return {name: round(ordered[round(q * last)], 4) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}


def figures(
    results: Sequence[Figures], seconds: float, before: Figures, after: Figures, rss_mb: list[float]
) -> Figures:
    """Returns the figures of the window.

    Args:
        results: the counts of each process of bots in the window (the last line that a `swarm` writes).
        seconds: length of the window.
        before, after: `/stats` at the start and end of the window; empty if the server does not provide it.
        rss_mb: samples of the server's memory in the window.
    """
    clients = [client for result in results for client in result["clients"]]
    n = len(clients)
    ticks = after["ticks"] - before["ticks"] if before and after else None
    server_cpu_s = after["cpu_s"] - before["cpu_s"] if ticks else 0.0
    gone = [client["left"] for client in clients if client["left"]]
    lag_counts: Counter[int] = Counter()
    for result in results:
        lag_counts.update(dict(result["lag_counts"]))

    def per_client_tick_us(cpu_s: float) -> float | None:
        return round(cpu_s * 1e6 / (n * ticks), 2) if ticks and n else None

    return {
        "clients": n,
        "seconds": round(seconds, 3),
        "tick_rate": after.get("tick_rate"),
        "server_ticks": ticks,
        "tick_lateness_ms": between(before[LATENESS], after[LATENESS]) if LATENESS in before and after else None,
        **_of_clients(clients, seconds),
        "server_cpu_us_per_client_tick": per_client_tick_us(server_cpu_s) if ticks else None,
        "server_cpu_share": round(server_cpu_s / seconds, 4) if ticks else None,
        "bots_cpu_us_per_client_tick": per_client_tick_us(sum(result["cpu_s"] for result in results)),
        "bots_lag_ms": between([], sorted(lag_counts.items())),
        "bots": [
            {
                "clients": len(result["clients"]),
                "cpu_share": round(result["cpu_s"] / seconds, 4),
                "lag_ms": between([], result["lag_counts"]),
            }
            for result in results
        ],
        "server_rss_mb": rss_mb,
        "disconnects": len(gone),
        "malformed": sum(left["code"] == MALFORMED for left in gone),
        "reasons": dict(Counter(left["reason"] for left in gone)),
    }


def _of_clients(clients: Sequence[Figures], seconds: float) -> Figures:
    """Returns the figures of all clients together: snapshots, inputs, corrections, and the connection."""
    n = len(clients)
    expected = max((client["ticks"] for client in clients), default=0)
    shares = sorted(min(1.0, client["snapshots"] / expected) if expected else 0.0 for client in clients)
    causes: Counter[str] = Counter()
    for client in clients:
        causes.update(client["causes"])

    def total(name: str) -> int:
        return int(sum(client[name] for client in clients))

    return {
        "snapshots_per_client_per_s": round(total("snapshots") / n / seconds, 3),
        "snapshots_share": {"worst": round(shares[0], 4), "p50": round(shares[n // 2], 4)},
        "clients_with_95_percent": sum(share >= SNAPSHOTS_SHARE_MIN for share in shares),
        "inputs_sent": total("inputs_sent"),
        "inputs_late": total("inputs_late"),
        "inputs_late_share": round(total("inputs_late") / max(1, total("inputs_sent")), 6),
        "corrections": total("corrections"),
        "corrections_per_client_minute": round(total("corrections") / n / seconds * 60, 3),
        "correction_blocks": quantiles([size for client in clients for size in client["correction_blocks"]]),
        "corrections_by_cause": dict(causes),
        "replayed_ticks_per_client_per_s": round(total("replayed_ticks") / n / seconds, 2),
        "resyncs": total("resyncs"),
        "lead_ticks": quantiles([client["lead_ticks"] for client in clients]),
        "rtt_ms": quantiles([client["rtt_ms"] for client in clients]),
        "bytes_per_client_per_s": {
            "up": round(total("bytes_up") / n / seconds, 1),
            "down": round(total("bytes_down") / n / seconds, 1),
        },
    }


def rows(f: Figures) -> list[tuple[str, str]]:
    """Returns the rows of the table: names and values."""
    lateness, sizes, bytes_s = f["tick_lateness_ms"], f["correction_blocks"], f["bytes_per_client_per_s"]
    memory, (lag_ms, share) = f["server_rss_mb"], _worst(f["bots"])
    return [
        ("clients", f"{f['clients']} for {f['seconds']:.1f} s at {f['tick_rate'] or '?'} ticks/s"),
        ("server ticks", _or_unknown(f["server_ticks"], "")),
        ("tick lateness", _three(lateness, "ms") if lateness else UNKNOWN),
        (
            "snapshots per client",
            f"{f['snapshots_per_client_per_s']:.1f} /s (worst {f['snapshots_share']['worst']:.1%})",
        ),
        ("inputs", f"{f['inputs_sent']} sent, {f['inputs_late_share']:.2%} late"),
        ("lead", f"{_three(f['lead_ticks'], 'ticks')}"),
        ("corrections", f"{f['corrections']} ({f['corrections_per_client_minute']:.1f} per client and minute)"),
        ("their size", _three(sizes, "blocks") if f["corrections"] else "none"),
        ("bytes per client", f"{bytes_s['up'] / 1e3:.2f} KB/s up, {bytes_s['down'] / 1e3:.2f} KB/s down"),
        ("server's CPU", _or_unknown(f["server_cpu_us_per_client_tick"], " us per client and tick")),
        ("bots' CPU", _or_unknown(f["bots_cpu_us_per_client_tick"], " us per client and tick")),
        ("bots' own lag", _three(f["bots_lag_ms"], "ms")),
        ("in the worst process", f"{lag_ms:.2f} ms (p99); the busiest took {share:.0%} of a core"),
        ("server memory", f"{memory[0]:.0f} to {memory[-1]:.0f} MB" if memory else UNKNOWN),
        ("disconnects", str(f["disconnects"])),
    ]


def verdict(f: Figures) -> list[Judgement]:
    """Returns the verdict: a sentence per figure that is good or bad."""
    n = f["clients"]
    good_clients, worst = f["clients_with_95_percent"], f["snapshots_share"]["worst"]
    judgements = [
        Judgement(
            good_clients == n,
            f"{good_clients} of {n} clients got at least 95 % of their snapshots (worst {worst:.1%})",
        ),
        Judgement(
            f["disconnects"] == 0,
            "no client lost its connection"
            if f["disconnects"] == 0
            else f"{f['disconnects']} of {n} clients lost their connection: " + "; ".join(f["reasons"]),
        ),
    ]
    if f["server_ticks"] is not None:
        judgements.append(_pace(f))
    late = f["inputs_late_share"]
    judgements.append(
        Judgement(
            late <= LATE_SHARE_MAX, f"{late:.2%} of the inputs arrived too late (up to {LATE_SHARE_MAX:.0%} is good)"
        )
    )
    judgements.append(_corrections(f))
    if held_up := bottleneck(f):
        judgements.append(Judgement(False, held_up))
    memory = f["server_rss_mb"]
    if len(memory) >= 2 * MEMORY_SETTLED_S:
        grown = memory[-1] - memory[MEMORY_SETTLED_S]
        judgements.append(
            Judgement(
                grown <= MEMORY_MB_MAX,
                f"the server's memory grew by {max(grown, 0):.1f} MB after the first {MEMORY_SETTLED_S} s",
            )
        )
    return judgements


def bottleneck(f: Figures) -> str:
    """Returns why the bots and not the server limited the figures; empty if they did not."""
    lag_ms, share = _worst(f["bots"])
    period_ms = 1e3 / (f["tick_rate"] or 32)
    always = max(bots["lag_ms"]["p50"] for bots in f["bots"]) > period_ms
    if always or share > BOTS_CPU_SHARE_MAX:
        cause = f"each process has too many bots ({share:.0%} of a core): use more --processes or fewer --clients"
    elif lag_ms > period_ms:
        cause = f"other work keeps this machine busy: the bots used at most {share:.0%} of a core each"
    else:
        return ""
    return (
        f"the bots themselves were late, by {lag_ms:.0f} ms or more for 1 % of the time; {cause}. Late inputs and "
        "corrections are due to the bots, not to the server"
    )


def failures(f: Figures) -> list[str]:
    """Returns why the test has failed; empty if it has not."""
    found = []
    if f["disconnects"]:
        found.append(f"{f['disconnects']} bot(s) died: " + "; ".join(f["reasons"]))
    if f["malformed"]:
        found.append(f"{f['malformed']} message(s) were malformed")
    return found


def _worst(bots: Sequence[Figures]) -> tuple[float, float]:
    """Returns the lag of the latest process (p99, in ms), and the share of a core that the busiest one used."""
    return max(each["lag_ms"]["p99"] for each in bots), max(each["cpu_share"] for each in bots)


def _pace(f: Figures) -> Judgement:
    wanted = f["tick_rate"] * f["seconds"]
    pace, period_ms = f["server_ticks"] / wanted, 1e3 / f["tick_rate"]
    text, good = f"the server ran {pace:.1%} of its ticks", pace >= PACE_MIN
    if f["tick_lateness_ms"]:
        p99 = f["tick_lateness_ms"]["p99"]
        text += f"; 99 % began within {p99:.1f} ms of their time (the period is {period_ms:.0f} ms)"
        good = good and p99 < period_ms
    return Judgement(good, text)


def _corrections(f: Figures) -> Judgement:
    if not f["corrections"]:
        return Judgement(True, "no prediction was corrected")
    causes: Counter[str] = Counter(f["corrections_by_cause"])
    by_late, unexplained = causes["late input"], causes[NONDETERMINISM]
    text = (
        f"{f['corrections']} corrections of {f['inputs_sent']} predicted ticks, half of them under "
        f"{max(f['correction_blocks']['p50'], 0.01):.2f} blocks, by cause: "
        + ", ".join(f"{cause} {n}" for cause, n in causes.most_common())
    )
    if unexplained:
        text += f"; {unexplained} without a cause, which must never happen: please report it"
    elif by_late > LATE_SHARE_MAX * f["inputs_sent"]:
        text += "; too many after late inputs"
    return Judgement(not unexplained and by_late <= LATE_SHARE_MAX * f["inputs_sent"], text)


def _three(values: dict[str, float], unit: str) -> str:
    return f"{values['p50']:.2f} / {values['p99']:.2f} / {values['max']:.2f} {unit} (p50 / p99 / max)"


def _or_unknown(value: float | None, unit: str) -> str:
    return UNKNOWN if value is None else f"{value:g}{unit}"
