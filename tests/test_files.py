"""Files that several processes share are written by one of them at a time."""

import time
from pathlib import Path
from threading import Thread

from jaxgran.files import file_lock


def test_who_waits_for_a_file_that_is_removed_does_not_enter_with_the_next(tmp_path: Path) -> None:
    """The first removes the lock and leaves; the second has waited, the third makes a new one."""
    path, inside, most = tmp_path / "new" / "file", [], []

    def enter(pause: float) -> None:
        with file_lock(path):
            inside.append(pause)
            most.append(len(inside))
            time.sleep(pause)
            inside.remove(pause)

    for _ in range(20):
        threads = [Thread(target=enter, args=(0.001 * k,)) for k in range(1, 9)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert set(most) == {1}
    assert list(path.parent.iterdir()) == []
