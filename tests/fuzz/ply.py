"""Mutated PLY files through the reader, guided by coverage (atheris, libFuzzer).

    python -m tests.fuzz.ply -runs=200000 -timeout=10 -rss_limit_mb=1024 [CORPUS_FOLDER]

A file is read or refused with an InputError; what was read is written and read again, and must be the same. Anything
else is a finding: libFuzzer writes the file down and ends with an exit code above 0.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["pointfilter", "plyfile"]):
    import pointfilter.formats.ply  # noqa: F401 - else it is loaded when the first file is, and nothing looks into it
    from pointfilter import PointCloud
    from pointfilter.errors import InputError

import numpy as np

from pointfilter.limits import ReadLimits
from tests.attacks.files import ATTACKS

LIMITS = ReadLimits(max_points=100_000)
LARGEST_SEED = 100_000
WORDS = (
    "ply", "format ascii 1.0", "format binary_little_endian 1.0", "format binary_big_endian 1.0", "element vertex 3",
    "element face 1", "property float x", "property double y", "property uchar z",
    "property list uchar int vertex_indices",
    "property list int float big", "comment", "obj_info", "end_header", "\\x0a", "\\x0d\\x0a", "nan", "inf", "1e308",
    "4294967295", "-1",
)  # fmt: skip


def try_one(folder: Path, data: bytes) -> None:
    source, target = folder / "in.ply", folder / "out.ply"
    source.write_bytes(data)
    try:
        cloud = PointCloud.read(source, LIMITS)
    except InputError:
        return
    cloud.with_xyz(cloud.xyz + 0.0).write(target)
    again = PointCloud.read(target, LIMITS)
    if len(again) != len(cloud) or not np.array_equal(again.xyz, cloud.xyz, equal_nan=True):
        raise AssertionError("what was written is not what was read")


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="pointfilter-fuzz-") as name:
        folder = Path(name)
        seeds, words = folder / "seeds", folder / "words"
        seeds.mkdir()
        for number, attack in enumerate(ATTACKS):
            path = seeds / f"{number}.ply"
            attack.write(path)
            if path.stat().st_size > LARGEST_SEED:
                path.unlink()
        words.write_text("".join(f'"{word}"\n' for word in WORDS))
        arguments = [*sys.argv, f"-dict={words}", f"-artifact_prefix={Path.cwd()}/"]
        if not any(not argument.startswith("-") for argument in sys.argv[1:]):
            arguments.append(str(folder / "found"))
            (folder / "found").mkdir()
        atheris.Setup([*arguments, str(seeds)], lambda data: try_one(folder, data))
        atheris.Fuzz()


if __name__ == "__main__":
    main()
