"""The cache of compiled programs on disk.

It imports `environment` and `files` only. `folder` locates the cache; `persistent_jit` keeps what
every command computes first.
"""
