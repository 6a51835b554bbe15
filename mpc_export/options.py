"""ExportOptions: all choices of an export in one frozen record."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal, TypedDict

from greybox.errors import UnknownNameError
from greybox.estimation.options import chosen
from greybox.takes import COUNT, POSITIVE, Kind, taken_fields
from mpc_export.targets import TARGETS as ADDED

FORMS = ("c", "casadi")
"""What all functions are written in."""
TARGETS = (*FORMS, *ADDED)
"""Those that `mpc_export.targets` adds come after the two that the bundle itself writes."""
Real = Literal["double", "float"]
REAL = Kind(
    words='"double" or "float"', fits=lambda v: isinstance(v, str) and v in ("double", "float")
)


class ExportChoices(TypedDict, total=False):
    """The keywords of `write_bundle`: the fields of `ExportOptions`, which says what they mean."""

    name: str | None
    dt: float | None
    targets: Iterable[str]
    real: Real
    with_: Iterable[str]
    runtime_parameters: Iterable[str]
    points: int | None
    horizon: int | None
    attempts: int
    use_cache: bool
    force: bool
    even_so: bool


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """All choices of an export; those of `model_functions` and of the command line."""

    name: str | None = None
    """Prefix of everything in C; None: the folder's name."""
    dt: float | None = None
    """Sample time [s]; None: the one that the model was identified at."""
    targets: tuple[str, ...] = FORMS
    """What is written, of `TARGETS`; where `with_` asks for functions and none of `FORMS` is
    among them, these too."""
    real: Real = "double"
    """Numbers in C."""
    with_: tuple[str, ...] = ()
    """Groups of functions besides the usual ones."""
    runtime_parameters: tuple[str, ...] = ()
    """Model parameters that stay arguments, by name, and "gp.weights"."""
    points: int | None = None
    """Support points that the learned part is projected on first; None: as it is."""
    horizon: int | None = None
    """Stages of the plan of the target tube."""
    attempts: int = 1
    """Attempts at a plan of the target tube within one step: 2 may take twice as long."""
    use_cache: bool = True
    """Whether the same bundle may come from the cache."""
    force: bool = False
    """Whether files of a bundle in the same place go that were changed or added since."""
    even_so: bool = False
    """Whether a model is written although flights judged it not usable."""

    def __post_init__(self) -> None:
        taken_fields(self, real=REAL, dt=POSITIVE, points=COUNT, horizon=COUNT, attempts=COUNT)

    @classmethod
    def of(cls, options: ExportOptions | None, choices: ExportChoices) -> ExportOptions:
        """`options` (None: the defaults) with the `choices` in place of its own. Raises
        `UnknownNameError`."""
        return chosen("option of an export", cls, options, choices)

    def completed(self) -> ExportOptions:
        """The same with what the targets need besides. Raises `UnknownNameError` (a target)."""
        targets = tuple(dict.fromkeys(self.targets))
        for target in targets:
            if target not in TARGETS:
                raise UnknownNameError("export target", target, TARGETS)
        added = [ADDED[target] for target in targets if target in ADDED]
        groups = {*self.with_, *(g for target in added for g in target.needs)}
        if self.with_ and not set(FORMS) & set(targets):
            targets = (*FORMS, *targets)  # else nothing that runs holds what was asked for
        if "c" not in targets and any(target.around_c for target in added):
            targets = ("c", *targets)
        return replace(self, targets=targets, with_=tuple(sorted(groups)))

    @property
    def shaping(self) -> list[object]:
        """What shapes the files of a bundle beside its name, for the key of the cache."""
        groups, runtime = self.with_, self.runtime_parameters
        return [
            self.dt,
            sorted(self.targets),
            self.real,
            groups,
            runtime,
            self.points,
            self.horizon,
            self.attempts,
        ]
