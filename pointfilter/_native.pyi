from typing import Any

from numpy.typing import NDArray

Index = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]

def count_neighbours(
    index: Index, centres: NDArray[Any], radius: float, enough: int, counts: NDArray[Any], /
) -> None: ...
def sample_neighbours(
    index: Index,
    centres: NDArray[Any],
    centre_ids: NDArray[Any],
    radius: float,
    key: int,
    indices: NDArray[Any],
    counts: NDArray[Any],
    /,
) -> None: ...
def build_patches(
    index: Index,
    centres: NDArray[Any],
    centre_ids: NDArray[Any],
    radius: float,
    key: int,
    patches: NDArray[Any],
    frames: NDArray[Any],
    counts: NDArray[Any],
    /,
) -> None: ...
def mean_vectors(
    index: Index,
    vectors: NDArray[Any],
    first: int,
    radius: float,
    enough: int,
    means: NDArray[Any],
    squares: NDArray[Any],
    counts: NDArray[Any],
    /,
) -> None: ...
