"""What was measured of a network at export, on procedural clouds; it travels with the weights in model.json."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any


@dataclass(frozen=True)
class Calibration:
    """How to use the expected errors of one network."""

    balls: tuple[int, ...]
    """Points in the balls that are compared, ascending."""
    preference: float
    """Added to the logarithm of an expected error for each doubling of the radius: above 0 for smaller balls, since
    later passes lower the error of a small ball further than that of a large one."""
    still_weight: float
    """Balls are compared by the logarithm of the expected error, less so much of that of the error without a filter: 1
    compares shares, in which what a ball knows wrongly cancels out, 0 the errors themselves."""
    margin: float
    """A point stays where it is unless its ball lowers the logarithm of the expected error by at least this much. Later
    decisions, whether it moves in a given pass and whether another pass follows, do not use the margin."""
    passes: int
    """Most passes over a cloud."""
    query_reach: float
    """Distance from the centre of a patch up to which the network answers, in units of the radius."""
    error_factor: float
    """Real error after all passes, divided by the expected one."""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Calibration:
        """Raises ValueError or TypeError where a value is missing, of the wrong type or out of range."""
        if set(values) != {field.name for field in fields(cls)}:
            raise ValueError(f"calibration must have {', '.join(field.name for field in fields(cls))}")
        balls = tuple(values["balls"])
        if (
            not balls
            or any(type(size) is not int for size in balls)
            or list(balls) != sorted(set(balls))
            or balls[0] < 4
        ):
            raise ValueError(f"calibration: balls must be ascending numbers of points from 4 on, not {balls}")
        numbers = {
            name: float(values[name])
            for name in ("preference", "still_weight", "margin", "query_reach", "error_factor")
        }
        if not (
            all(map(math.isfinite, numbers.values()))
            and 0 <= numbers["query_reach"] <= 1
            and numbers["error_factor"] > 0
            and abs(numbers["preference"]) <= 10
            and 0 <= numbers["still_weight"] <= 1
        ):
            raise ValueError(f"calibration: out of range: {numbers}")
        passes = values["passes"]
        if type(passes) is not int or not 1 <= passes <= 100:
            raise ValueError(f"calibration: passes must be from 1 to 100, not {passes!r}")
        return cls(balls=balls, passes=passes, **numbers)

    def as_dict(self) -> dict[str, Any]:
        return {**asdict(self), "balls": list(self.balls)}
