"""Flags and limits of the environment change no number, and end no command in a traceback."""

from pathlib import Path

import jax
import numpy as np
import pytest
from command_line import in_a_process

from jaxgran.cache import folder
from jaxgran.environment import usable_cores
from jaxgran.maps.provenance import random_bits
from jaxgran.maps.replica import ReplicaId
from jaxgran.maps.run import _folded_key, random_key

REPLICA = ReplicaId(64, 1e-3, 0.6, 0.5, 3)


@pytest.mark.parametrize(
    ("flag", "value"), [("jax_default_prng_impl", "rbg"), ("jax_random_seed_offset", 7)]
)
def test_keys_do_not_depend_on_flags(flag: str, value, monkeypatch) -> None:
    key = jax.random.fold_in(jax.random.key(3), np.uint32(REPLICA.checksum))
    expected, before = jax.random.key_data(key), getattr(jax.config, flag)
    np.testing.assert_array_equal(random_key(REPLICA), expected)
    jax.config.update(flag, value)
    try:
        plain = _folded_key.__wrapped__(3, np.uint32(REPLICA.checksum))
    finally:
        jax.config.update(flag, before)
    np.testing.assert_array_equal(plain, expected)


def test_another_partition_of_random_bits_is_another_generator() -> None:
    here = random_bits()
    with jax.threefry_partitionable(not jax.config.jax_threefry_partitionable):
        assert random_bits() != here


@pytest.mark.parametrize(
    ("groups", "folder", "limited", "unlimited"),
    [
        ("0::/user/job", "user", {"cpu.max": "100000 100000"}, {"cpu.max": "max 100000"}),
        (
            "7:memory:/job\n4:cpu,cpuacct:/job\n0::/",
            "cpu/job",
            {"cpu.cfs_quota_us": "50000", "cpu.cfs_period_us": "100000"},
            {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"},
        ),
    ],
    ids=["version 2, of the group above", "version 1"],
)
def test_a_quota_of_one_core_is_one_thread(groups, folder, limited, unlimited, tmp_path) -> None:
    files = {"proc/self/cgroup": groups}
    for quota, cores in ((limited, 1), (unlimited, usable_cores())):
        files |= {f"sys/fs/cgroup/{folder}/{name}": text for name, text in quota.items()}
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"{text}\n")
        assert usable_cores(tmp_path) == cores


def test_a_cache_in_a_bucket_is_no_folder_here() -> None:
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", "gs://bucket/x")
    try:
        assert folder.programs_folder() is None
    finally:
        jax.config.update("jax_compilation_cache_dir", before)


def test_a_user_without_a_home_has_no_cache_there(monkeypatch) -> None:
    def no_home(_: str) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(folder, "user_cache_path", no_home)
    assert folder.why_unwritable(folder.users_folder()) == "there is no home folder"


@pytest.mark.parametrize(
    ("name", "value"),
    [("JAX_DISABLE_JIT", "1"), ("NUMBA_DISABLE_JIT", "1"), ("NUMBA_NUM_THREADS", "0")],
)
def test_flags_with_which_nothing_is_compiled_are_named(name, value, tmp_path, monkeypatch) -> None:
    """By a user without a compiled engine on disk."""
    monkeypatch.setenv(name, value)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    flow = ("--restitution", "0.5", "--packing-fraction", "0.5", "-n", "16")
    done = in_a_process(tmp_path, "run", *flow, "--strain", "1", "--equilibrate", "0.1")
    sentence = done.err.splitlines()[-1]
    assert done.status == 2 and "Traceback" not in done.err
    assert sentence.startswith("jaxgran: ") and name in sentence and sentence.endswith(".")
