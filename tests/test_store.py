"""A file is there whole or not at all; one that is not what was written is damaged."""

from pathlib import Path

import numpy as np
import pytest

from jaxgran.files import atomic_write
from jaxgran.io.arrays import CorruptFile, read_arrays, write_arrays

ARRAYS = {
    "numbers": np.random.default_rng(0).normal(size=(3, 7)),
    "keys": np.arange(6, dtype=np.int64).reshape(3, 2),
    "single": np.float32([1.5, np.nan]),
    "nothing": np.empty((0, 4)),
    "scalar": np.asarray(2.5),
}
ABOUT = {"grains": 64, "timestep": [1e-3, 1e-4], "name": "σ ± 0.26", "none": None}


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "arrays.npz"
    write_arrays(path, ARRAYS, ABOUT)
    return path


def reads_as_written(path: Path) -> bool:
    """Whether a file holds what was written; False where it is known to be damaged."""
    try:
        arrays, about = read_arrays(path)
    except CorruptFile:
        return False
    assert set(arrays) == set(ARRAYS) and about == ABOUT
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)
    return True


def test_a_flipped_bit_is_noticed_or_changes_nothing_wherever_it_is(file: Path) -> None:
    assert reads_as_written(file)
    whole, noticed = file.read_bytes(), 0
    for place in range(len(whole)):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << (place % 8)
        file.write_bytes(flipped)
        noticed += not reads_as_written(file)
    assert noticed > 0.8 * len(whole)


def test_a_torn_file_is_noticed_wherever_it_ends(file: Path) -> None:
    whole = file.read_bytes()
    for size in [*range(0, len(whole), 97), *range(len(whole) - 40, len(whole))]:
        file.write_bytes(whole[:size])
        assert not reads_as_written(file)


def test_what_is_no_file_of_ours_is_damaged(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_bytes(b"not arrays")
    np.savez(tmp_path / "others.npz", **ARRAYS)
    for name in ("text.npz", "others.npz", "none.npz", "."):
        with pytest.raises(CorruptFile):
            read_arrays(tmp_path / name)


def test_a_link_stays_a_link_and_permissions_stay(file: Path) -> None:
    file.chmod(0o640)
    folder = file.parent / "elsewhere"
    folder.mkdir()
    link = folder / "link.npz"
    link.symlink_to(file)
    write_arrays(link, {}, {})
    assert link.is_symlink() and read_arrays(file) == ({}, {})
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(folder.iterdir()) == [link]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(file: Path) -> None:
    with pytest.raises(RuntimeError), atomic_write(file) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert reads_as_written(file)
    assert [path.name for path in file.parent.iterdir()] == [file.name]
