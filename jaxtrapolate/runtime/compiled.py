"""Compiled programs that outlive a process: JAX's persistent cache, in the user's cache folder.

The commands use it, so that a second run of the same sizes starts at once; who imports the library decides for himself
(`JAX_COMPILATION_CACHE_DIR`). It holds at most 2 GB, the least recently used programs go first.
"""

import contextlib
import gc
import os
from collections.abc import Callable, Iterator
from typing import Any

_EVENT = "/jax/compilation_cache/cache_hits"
_SETTINGS = {
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(2 << 30),
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2",
}


def keep_compiled_programs() -> None:
    """Makes this process and those that it starts keep compiled programs, unless a cache or none is asked for.

    To be called before JAX is imported: it sets what JAX reads then. Nothing is changed where the environment names a
    cache, or where there is no folder for one.
    """
    import platformdirs

    if "JAX_COMPILATION_CACHE_DIR" in os.environ or "JAX_ENABLE_COMPILATION_CACHE" in os.environ:
        return
    folder = os.path.join(platformdirs.user_cache_dir("jaxtrapolate", appauthor=False), "compiled")
    try:
        os.makedirs(folder, exist_ok=True)
    except OSError:
        return
    if os.access(folder, os.W_OK):
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
        for name, value in _SETTINGS.items():
            os.environ.setdefault(name, value)


def forget_compiled_programs() -> None:
    """Makes this process compile everything anew."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)


def spare_memory_maps(share: float = 0.6) -> bool:
    """Forgets compiled programs where they have taken up a share of the memory maps that Linux gives a process.

    Each program keeps some, and XLA ends a process that gets no more. What is needed again is compiled again, or read
    from the cache. To be called where much that was compiled will not be: between inputs.

    Returns:
        Whether they were forgotten; never where the system does not say how many maps there are.
    """
    try:
        with open("/proc/self/maps", "rb") as maps, open("/proc/sys/vm/max_map_count", "rb") as most:
            if sum(1 for _ in maps) < share * int(most.read()):
                return False
    except OSError:
        return False
    import jax

    jax.clear_caches()
    gc.collect()
    return True


@contextlib.contextmanager
def cache_hits() -> Iterator[Callable[[], int]]:
    """How many programs were read from the cache, instead of being compiled, since the block was entered."""
    import jax

    count = 0

    def listen(event: str, **_: Any) -> None:
        nonlocal count
        count += event == _EVENT

    jax.monitoring.register_event_listener(listen)
    try:
        yield lambda: count
    finally:
        jax.monitoring.unregister_event_listener(listen)
