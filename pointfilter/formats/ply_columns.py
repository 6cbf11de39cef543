"""Vertex columns that a cloud sets or drops: the edited header, and edited rows of each encoding.

Everything that is not named keeps its bytes. New columns are float and come last.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pointfilter.formats.ply_header import ByteOrder, Element, decoded

Float64 = NDArray[np.float64]

NEW_TYPE = "f4"
_NEW_SPELLING = b"float"


@dataclass(frozen=True, eq=False)
class ColumnEdit:
    """What becomes of the columns of n vertices. replaced: new values (n,) float64 of columns that the file has.
    added: values (n,) float64 of columns that it does not have. dropped: columns of the file that are left out."""

    replaced: dict[str, Float64]
    added: dict[str, Float64]
    dropped: frozenset[str]

    @classmethod
    def of(cls, vertex: Element, columns: Mapping[str, Float64], dropped: AbstractSet[str]) -> ColumnEdit:
        known = {property.name for property in vertex.properties}
        return cls(
            replaced={name: values for name, values in columns.items() if name in known},
            added={name: values for name, values in columns.items() if name not in known},
            dropped=frozenset(dropped & known),
        )

    @property
    def changes_layout(self) -> bool:
        return bool(self.added or self.dropped)

    def header(self, raw: bytes, ending: bytes) -> bytes:
        """The header's lines without the dropped columns and with the added ones."""
        if not self.changes_layout:
            return raw
        lines = [line + b"\n" for line in raw.split(b"\n")[:-1]]
        words = [line.split() for line in lines]
        begin = next(k for k, each in enumerate(words) if each[:2] == [b"element", b"vertex"])
        after = (k for k, each in enumerate(words) if k > begin and each[:1] == [b"element"])
        inside = [k for k in range(begin + 1, next(after, len(lines))) if words[k][:1] == [b"property"]]
        new = [b"property " + _NEW_SPELLING + b" " + name.encode() + ending for name in self.added]
        edited = []
        for number, line in enumerate(lines):
            if not (number in inside and decoded(words[number][-1]) in self.dropped):
                edited.append(line)
            if number == inside[-1]:
                edited += new
        return b"".join(edited)

    def rows(self, rows: NDArray[np.uint8], vertex: Element, order: ByteOrder) -> NDArray[np.uint8]:
        """Edited rows of binary vertices without lists, (n * bytes of a row,) uint8 as `rows`."""
        sizes = [property.dtype(order).itemsize for property in vertex.properties]
        kept = [property.name not in self.dropped for property in vertex.properties]
        table = rows.reshape(vertex.count, sum(sizes))[:, np.repeat(kept, sizes)]
        return np.concatenate([table, self._added_bytes(vertex.count, order)], axis=1).ravel()

    def rows_with_lists(
        self,
        rows: memoryview,
        steps: Sequence[tuple[str, struct.Struct | None, int]],
        order: ByteOrder,
    ) -> Iterator[bytes]:
        """Edited rows of binary vertices that hold lists, one by one. steps: name, length and item of each column."""
        added = self._added_bytes(self._count, order) if self.added else None
        position = row = 0
        while position < len(rows):
            pieces: list[bytes | memoryview] = []
            for name, length, item in steps:
                start = position
                position += item if length is None else length.size + length.unpack_from(rows, position)[0] * item
                if name not in self.dropped:
                    pieces.append(rows[start:position])
            if added is not None:
                pieces.append(added[row].tobytes())
            row += 1
            yield b"".join(pieces)

    def lines(self, lines: list[list[bytes]], vertex: Element, part: slice) -> list[list[bytes]]:
        """Edited lines of ascii vertices, the rows `part`; a line is [blank, value, blank, value, ..., blank]."""
        new = [values[part].astype(NEW_TYPE).astype(str).tolist() for values in self.added.values()]
        edited = []
        for row, pieces in enumerate(lines):
            kept = self._kept_values(pieces, vertex) if self.dropped else pieces[:-1]
            added = [piece for texts in new for piece in (b" ", texts[row].encode())]
            edited.append([pieces[0], *kept[1:], *added, pieces[-1]])
        return edited

    def _kept_values(self, pieces: list[bytes], vertex: Element) -> list[bytes]:
        """The blanks and values of a line, without the blank at its end and without those of dropped columns."""
        kept = []
        value = 0
        for property in vertex.properties:
            count = 1 + (int(pieces[2 * value + 1]) if property.length_type else 0)
            if property.name not in self.dropped:
                kept += pieces[2 * value : 2 * (value + count)]
            value += count
        return kept

    @property
    def _count(self) -> int:
        return len(next(iter(self.added.values())))

    def _added_bytes(self, count: int, order: ByteOrder) -> NDArray[np.uint8]:
        """(n, bytes) uint8 of the added columns."""
        dtype = np.dtype(NEW_TYPE).newbyteorder(order)
        table = np.empty((count, len(self.added)), dtype=dtype)
        for number, values in enumerate(self.added.values()):
            with np.errstate(over="ignore"):
                table[:, number] = values
        return table.view(np.uint8).reshape(count, len(self.added) * dtype.itemsize)
