"""greybox as on a system that is neither Linux nor macOS, as far as Linux can play it: `python -m
tests.packaging.foreign_system COMMAND ...`.

What only POSIX has is taken away, processes are spawned, there is no compiler, and a text file that
is opened without its encoding by code of ours is an error (elsewhere the default is not UTF-8). The
lines run again in every spawned process.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import warnings

MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog")
OF_OS = (
    "fork",
    "forkpty",
    "getuid",
    "geteuid",
    "getgid",
    "getegid",
    "setuid",
    "statvfs",
    "fstatvfs",
    "sysconf",
    "killpg",
    "setsid",
    "getpgid",
    "getloadavg",
    "sched_getaffinity",
    "sched_setaffinity",
    "mkfifo",
    "nice",
    "chown",
    "lchown",
    "posix_fadvise",
    "posix_fallocate",
    "posix_spawn",
    "wait3",
    "wait4",
    "O_NOFOLLOW",
    "O_DIRECTORY",
    "O_NONBLOCK",
)
OF_SIGNAL = (
    "SIGKILL",
    "SIGALRM",
    "SIGHUP",
    "SIGUSR1",
    "SIGUSR2",
    "SIGXCPU",
    "SIGPIPE",
    "alarm",
    "setitimer",
)


def strip() -> None:
    """Take away what only POSIX has."""
    # The standard library reads some of these when it is first imported.
    import asyncio  # noqa: F401
    import concurrent.futures.process  # noqa: F401
    import subprocess  # noqa: F401
    import tempfile  # noqa: F401

    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in ((os, OF_OS), (signal, OF_SIGNAL)):
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    os.environ["PATH"] = ""
    os.environ["GREYBOX_COMPILER"] = "none"
    multiprocessing.set_start_method("spawn", force=True)
    for name in ("greybox", "mpc_export"):
        warnings.filterwarnings("error", category=EncodingWarning, module=rf"{name}(\.|$)")


strip()

if __name__ == "__main__":
    from greybox.cli import main

    sys.exit(main())
