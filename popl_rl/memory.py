"""Memory that is freed and soon needed again, kept by the process."""

import ctypes

__all__ = ["keep_freed_memory"]

# Of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_BYTES = 1 << 30


def keep_freed_memory() -> bool:
    """Let the C library keep up to 1 GiB of freed memory instead of returning it to the system.

    Scoring takes and frees the same large blocks at every gradient step. By its defaults glibc
    returns each of them and takes it again, page by page: a quarter of the processor's time, where
    observations are continuous and seldom repeat. No result depends on it.

    Returns:
        Whether there is such a setting; not on other systems than Linux with glibc.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return all(mallopt(setting, _BYTES) == 1 for setting in (_TRIM_THRESHOLD, _MMAP_THRESHOLD))
