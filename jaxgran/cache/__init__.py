"""The cache of compiled programs on disk.

It imports `environment` and `files` only. `folder` locates the cache; `persistent_jit` stores
compiled functions there.
"""
