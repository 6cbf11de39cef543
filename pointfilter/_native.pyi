from typing import Any

from numpy.typing import NDArray

Index = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]

def build_patches(
    index: Index,
    positions: NDArray[Any],
    radii: NDArray[Any],
    key: int,
    patches: NDArray[Any],
    frames: NDArray[Any],
    counts: NDArray[Any],
    /,
) -> None: ...
def ball_radii(
    index: Index, positions: NDArray[Any], guesses: NDArray[Any], sizes: NDArray[Any], radii: NDArray[Any], /
) -> None: ...
def smallest_key(
    index: Index, positions: NDArray[Any], radii: NDArray[Any], keys: NDArray[Any], owners: NDArray[Any], /
) -> None: ...
