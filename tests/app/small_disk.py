"""Small disks of tests: file systems in memory, and folders that are mounted in another place."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


class Disk:
    """A file system in memory of a given size; tests are skipped where none can be mounted."""

    def __init__(self, folder: Path, size_bytes: int) -> None:
        if os.geteuid() != 0:
            pytest.skip("only root can mount a small disk to fill")
        self.folder = folder
        folder.mkdir(mode=0o755)
        self._mount(f"size={size_bytes}", "-t", "tmpfs")

    def grow(self, size_bytes: int) -> None:
        """Give the disk another size."""
        self._mount(f"remount,size={size_bytes}")

    def fill(self, left_bytes: int = 0) -> Path:
        """Fill the disk but for a few bytes; returns the file that does."""
        ballast = self.folder / "ballast"
        free = shutil.disk_usage(self.folder).free
        with ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, free - left_bytes)
        return ballast

    def protect(self) -> None:
        """Mount the disk read-only."""
        self._mount("remount,ro")

    def unprotect(self) -> None:
        """Let the disk be written again."""
        self._mount("remount,rw")

    def remove(self) -> None:
        """Unmount the disk."""
        subprocess.run(["umount", "--lazy", str(self.folder)], check=True)

    def _mount(self, options: str, *more: str) -> None:
        command = ["mount", *more, "-o", options, "amers-test", str(self.folder)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            pytest.skip(f"no file system can be mounted here: {result.stderr.strip()}")


class BindMount:
    """A folder that is mounted in another place; tests are skipped where nothing can be mounted."""

    def __init__(self, folder: Path, source: Path) -> None:
        if os.geteuid() != 0:
            pytest.skip("only root can mount a folder in another place")
        self.folder = folder
        self.source = source

    def mount(self) -> None:
        """Mount the folder."""
        command = ["mount", "--bind", str(self.source), str(self.folder)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode != 0:
            pytest.skip(f"no folder can be mounted here: {result.stderr.strip()}")

    def unmount(self) -> None:
        """Unmount the folder, which nobody may hold open; an empty one stays in its place."""
        subprocess.run(["umount", str(self.folder)], check=True)
