"""Measured values of an attack, and their limits."""

from dataclasses import dataclass
from math import inf
from typing import Final

from tests.attack.hostile import Deeds

CLIENTS: Final = 256
"""Number of hostile clients at the same time."""
P99_LIMIT_MS: Final = 5.0
"""Maximum of the 99th percentile of two delays, ms: replies to the good client, and its samples after their arrival."""
RSS_LIMIT_MB: Final = 64 * 1.048576
"""Maximum memory above idle, MB: `socket.memory_mb`, the limit for all queued data of clients."""
WAKERS_PER_USER: Final = 4 * 128
"""Maximum number of `notify` descriptors of one user: 4 × `socket.clients_per_user` (docs/socket.md)."""
HOSTILE_USERS: Final = 2
FDS_OTHERS: Final = 64
"""Maximum number of other descriptors: 32 scrapes, 5 of a reconnected device, clients of this program."""
FDS_LIMIT: Final = CLIENTS + HOSTILE_USERS * WAKERS_PER_USER + FDS_OTHERS
"""Maximum number of descriptors above idle: hostile clients, their users' `notify` descriptors, and others."""
FDS_LEFT_LIMIT: Final = 4
"""Maximum number of descriptors above the number before the attack. More descriptors are a leak."""
LEDGER_TOLERANCE: Final = 1
"""Maximum difference between the losses in the ledger and the frames that the port rejected, samples."""


@dataclass
class Measured:
    deeds: Deeds
    samples: int = 0
    lost: int = 0
    dropped: int = 0
    """Number of these samples that the daemon reports as dropped."""
    reply_p50_ms: float = 0.0
    reply_p99_ms: float = 0.0
    reply_max_ms: float = 0.0
    sample_p99_ms: float = 0.0
    above_mb: float = 0.0
    fds: int = 0
    fds_left: int = 0
    cpu_share: float = 0.0
    refused: int = 0
    evicted: int = 0
    failed: int = 0
    port_refused: int = 0
    """Number of frames for which the device's port had no room: the true losses."""
    ledger_lost: int = 0
    ledger_unknown: int = 0
    """Number of gaps of unknown size in the ledger."""
    stops: int = 0


def exceeded(seen: Measured, *, delays: bool = True) -> list[str]:
    """Return the exceeded limits. Include limits of delays only if `delays` is True.

    An attack that stops the daemon causes losses and delays. In this case, the losses must be equal to the frames that
    the port rejected.
    """
    starves = seen.stops > 0
    p99_limit_ms = P99_LIMIT_MS if delays and not starves else inf
    problems = [
        f"{name} {value:.4g}{unit}, expected at most {limit:.4g}{unit}"
        for name, value, limit, unit in (
            ("p99 of the good client's replies", seen.reply_p99_ms, p99_limit_ms, " ms"),
            ("p99 of the good client's samples", seen.sample_p99_ms, p99_limit_ms, " ms"),
            ("memory above idle", seen.above_mb, RSS_LIMIT_MB, " MB"),
            ("descriptors above idle", seen.fds, FDS_LIMIT, ""),
            ("descriptors left over", seen.fds_left, FDS_LEFT_LIMIT, ""),
            ("errors in the daemon while a client was served", seen.failed, 0, ""),
        )
        if value > limit
    ]
    if not seen.samples:
        problems.append("the good client received no samples")
    return problems + _losses(seen, starves)


def _losses(seen: Measured, starves: bool) -> list[str]:
    problems = []
    if not starves and (seen.lost or seen.dropped or seen.port_refused):
        problems.append(
            f"{seen.lost} samples lost, {seen.dropped} of them dropped for the good client,"
            f" {seen.port_refused} rejected by the port"
        )
    if abs(seen.ledger_lost - seen.port_refused) > LEDGER_TOLERANCE:
        problems.append(
            f"the ledger has {seen.ledger_lost} lost samples, the port rejected {seen.port_refused}:"
            f" expected a difference of at most {LEDGER_TOLERANCE}"
        )
    if abs(seen.lost - seen.dropped - seen.port_refused) > LEDGER_TOLERANCE:
        problems.append(f"the good client missed {seen.lost} samples, the port rejected {seen.port_refused}")
    if seen.ledger_unknown:
        problems.append(f"{seen.ledger_unknown} gaps of unknown size, although the device sends its time")
    return problems
