"""Modules that a twin wrote, imported from their folder."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def load(folder: Path, *names: str) -> tuple[ModuleType, ...]:
    """The modules of these names in `folder`, which may import each other."""
    sys.path.insert(0, str(folder))
    kept = {n: sys.modules.pop(n, None) for n in (*names, "commands")}
    try:
        found = []
        for name in names:
            spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            spec.loader.exec_module(module)
            found.append(module)
        return tuple(found)
    finally:
        sys.path.remove(str(folder))
        for name, module in kept.items():
            sys.modules.pop(name, None)
            if module is not None:
                sys.modules[name] = module
