"""Limits on what is read. The library's defaults only stop nonsense; the service sets its own."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReadLimits:
    """Largest files that a reader takes; larger ones raise LimitExceededError naming the knob."""

    max_points: int = 2**31 - 1
    max_header_bytes: int = 1 << 20
    max_points_knob: str = "max_points"
    """What the person who meets the limit can turn: an argument here, an environment variable in the service."""
