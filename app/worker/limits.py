"""The exit codes of a process that does an attempt, and the limits that the kernel holds it to."""

import resource
import signal
from pathlib import Path

OUT_OF_MEMORY = 77
"""Exit code of a process that reached its memory limit."""
NO_ROOM = 78
"""Exit code of a process that found a disk full."""
STORAGE_AWAY = 79
"""Exit code of a process whose storage is not mounted, is another one or takes no files."""


def limit_memory(extra_bytes: int) -> None:
    """Limit what this process may allocate in addition to what its libraries have already reserved."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + extra_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def limit_files(largest_bytes: int) -> None:
    """Make the kernel end this process by SIGXFSZ when it writes a larger file, in whatever library."""
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_bytes, largest_bytes))
