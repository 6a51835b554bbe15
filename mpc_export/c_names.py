"""Names of bundles: what C, C++ and CMake take as the prefix of everything, and where a name is put
into C that was written with another.

A name stands before an underscore nearly everywhere (`quad_f_d`), so names of functions (`sin`,
`free`, `main`) do no harm. By itself it is the name of a header, a library and a target of CMake.
"""

from __future__ import annotations

import re

from greybox.errors import ModelError


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


WORDS = _set(
    "auto break case char const continue default do double else enum extern float for goto if inline "
    "int long register restrict return short signed sizeof static struct switch typedef union "
    "unsigned void volatile while alignas alignof and and_eq asm bitand bitor bool catch class "
    "compl concept const_cast consteval constexpr constinit co_await co_return co_yield decltype "
    "delete dynamic_cast explicit export false friend mutable namespace new noexcept not not_eq "
    "nullptr operator or or_eq private protected public reinterpret_cast requires static_assert "
    "static_cast template this thread_local throw true try typeid typename using virtual wchar_t "
    "xor xor_eq"
)
"""Words of C and C++."""
HEADERS = _set(
    "alloca assert complex ctype dirent dlfcn endian errno fcntl features fenv float getopt ieeefp "
    "inttypes iso646 limits locale malloc math memory newlib poll pthread reent regex sched "
    "semaphore setjmp signal stdalign stdarg stdatomic stdbit stdbool stddef stdint stdio stdlib "
    "stdnoreturn string strings tgmath threads time uchar unistd wchar wctype"
)
"""NAME.h of these names would stand before the system's, which includes its own by them."""
TARGETS = _set(
    "all all_build c clean debug depend edit_cache general help install m optimized package "
    "package_source preinstall properties px4 rebuild_cache run_tests test u zero_check"
)
"""Of CMake, in whatever letters, libraries of the system (lib`c`, lib`m`), and what the system puts
before an underscore itself: `u_int`, PX4_OK."""
FREE = "--name quad"
CMAKE = frozenset(
    ("COMPILE_FLAGS", "DEPENDS", "EXTERNAL", "MAIN", "MODULE", "PRIORITY", "SRCS", "STACK")
)
"""What PX4's CMake looks for between names, in these letters."""


def check_prefix(name: str) -> str:
    """The name, if it may stand before an underscore in C. Raises `ModelError`."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name) or name.lower().startswith("casadi"):
        raise ModelError(
            "the bundle's name is not a C identifier",
            expected="at most 41 letters, digits and underscores, a letter first, not casadi...",
            got=repr(name),
            fix=FREE,
        )
    return name


def check_name(name: str) -> str:
    """The name, if C, C++ and their builds take it as the prefix of everything. Raises
    `ModelError`."""
    check_prefix(name)
    if what := _taken(name):
        raise ModelError(f"the bundle's name {what}", got=repr(name), fix=FREE)
    return name


def name_of_folder(folder: str) -> str:
    """The name of a bundle that was given none: that of its folder, with _model behind it where it
    is taken (`export`, `test`)."""
    return check_name(f"{folder}_model" if _taken(folder) else folder)


def _taken(name: str) -> str:
    """By what a name is taken; empty where it is free."""
    if name in WORDS:
        return "is a word of C or C++"
    if name.lower() in HEADERS:
        return "is that of a header of the system"
    return "is taken in C builds" if name.lower() in TARGETS or name in CMAKE else ""


def renamed(text: str, old: str, new: str) -> str:
    """C in which every identifier that begins with `old` begins with `new` instead. What merely has
    `old` in it stays."""
    return re.sub(rf"\b{re.escape(old)}(?=\w)", lambda _: new, text, flags=re.ASCII)
