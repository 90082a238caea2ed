"""Cache files are read whole or not at all, and the oldest go."""

import os
from pathlib import Path

from jaxgran.files import read_cached, write_cached


def test_a_kept_file_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    path, content = tmp_path / "cache" / "program.bin", b"a program" * 100
    assert read_cached(path) is None
    write_cached(path, content, 1)
    assert read_cached(path) == content
    assert [file.name for file in path.parent.iterdir()] == ["program.bin"]
    whole = path.read_bytes()
    for torn in (b"", whole[:20], whole[:-1], whole[:500] + b"!" + whole[501:]):
        path.write_bytes(torn)
        assert read_cached(path) is None


def test_only_some_files_are_kept_and_the_oldest_go(tmp_path: Path) -> None:
    for k in range(5):
        write_cached(tmp_path / f"{k}.bin", b"program", 3)
        os.utime(tmp_path / f"{k}.bin", (k, k))
    write_cached(tmp_path / "last.bin", b"program", 3)
    assert {path.name for path in tmp_path.iterdir()} == {"last.bin", "3.bin", "4.bin"}
