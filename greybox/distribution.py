"""Distribution: the name and version that greybox is installed under, and how its extras are added.

The name `greybox` on the Python Package Index belongs to another project (time series models).
Both put their files into a folder `greybox`, so that an environment can hold only one of them.
"""

from __future__ import annotations

from importlib import metadata

NAME = "greybox-sysid"
"""Name on the package index; the import name is greybox."""
VERSION = "0.1.0"
TORCH_CPU = "https://download.pytorch.org/whl/cpu"
"""Index of PyTorch's builds without CUDA, for every Python, on Linux, macOS and Windows."""


def install_line(extra: str) -> str:
    """What to type for an extra. PyTorch comes first, from the index of its small CPU builds: the
    package index alone gives a build with CUDA of several gigabytes on Linux."""
    line = f'pip install "{NAME}[{extra}]"'
    return f"pip install torch --index-url {TORCH_CPU} && {line}" if extra == "gp" else line


def other_greybox() -> str | None:
    """Version of the other project called greybox where it is in this environment, None elsewhere.

    An installation of this project from a checkout has no files of its own under that name.
    """
    try:
        found = metadata.distribution("greybox")
    except metadata.PackageNotFoundError:
        return None
    if found.metadata["Name"] != "greybox":
        return None
    mine = any(str(f) == "greybox/__init__.py" for f in found.files or ())
    return found.version if mine else None
