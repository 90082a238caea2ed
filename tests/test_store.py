"""A file is there whole or not at all, and one that is not what was written is known to be damaged."""

from pathlib import Path

import numpy as np
import pytest

from jaxgran.store import Damaged, read_arrays, replaced, write_arrays

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
    path = tmp_path / "arrays.nc"
    write_arrays(path, ARRAYS, ABOUT)
    return path


def reads_as_written(path: Path) -> bool:
    """Whether a file holds what was written; False where it is known to be damaged."""
    try:
        arrays, about = read_arrays(path)
    except Damaged:
        return False
    assert set(arrays) == set(ARRAYS) and about == ABOUT
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(arrays[name], array)
    return True


def test_arrays_come_back_bit_for_bit(file: Path) -> None:
    assert reads_as_written(file)


def test_a_flipped_bit_is_noticed_or_harmless(file: Path) -> None:
    whole, found = file.read_bytes(), []
    for place in np.random.default_rng(1).integers(0, len(whole), 400):
        torn = bytearray(whole)
        torn[place] ^= 1 << int(place % 8)
        file.write_bytes(torn)
        found.append(reads_as_written(file))
    assert not all(found)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_torn_file_is_damaged(file: Path, share: float) -> None:
    whole = file.read_bytes()
    file.write_bytes(whole[: int(share * len(whole))])
    assert not reads_as_written(file)


def test_what_is_no_file_of_ours_is_damaged(tmp_path: Path) -> None:
    (tmp_path / "text.nc").write_text("not arrays")
    for name in ("text.nc", "none.nc", "."):
        with pytest.raises(Damaged):
            read_arrays(tmp_path / name)


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(file: Path) -> None:
    with pytest.raises(RuntimeError), replaced(file) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError
    assert reads_as_written(file)
    assert [path.name for path in file.parent.iterdir()] == [file.name]
