"""FMU: dx/dt and outputs of a continuous model as an FMI 3.0 model-exchange FMU, by CasADi's own
exporter.

Variables: the states, commands and run-time parameters by their names in the bundle, the outputs as
`y.<name>`; start values are the reference point. It holds f, which has no delay and no command
history; f_d, the authoritative model, is in the rest of the bundle. Units stand in the
descriptions, because the exporter writes no unit definitions. The sources are always inside; a
binary for this platform is, when a C compiler and the FMI headers that come with fmpy are at hand.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import re
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca

from greybox.errors import ModelError
from mpc_export.exported import Exported

if TYPE_CHECKING:
    from mpc_export.manifest import TargetPart


EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every entry of the archive: the same model gives the same bytes."""


def write_fmu(model: Exported, path: Path) -> TargetPart:
    """Write the FMU to `path`; returns {"file", "binary": whether one for this platform is inside}.

    Raises `ModelError` for a discrete model, and where CasADi has no exporter (before 3.8).
    """
    if "f" not in model:
        raise ModelError(
            f"{model.name} is discrete, so an FMU for model exchange has nothing to hold",
            fix="leave fmu out",
        )
    if not hasattr(ca.DaeBuilder, "compile_fmu"):
        raise ModelError(
            "this CasADi cannot export an FMU", expected="3.8 or later", got=ca.CasadiMeta.version()
        )
    builder = _builder(model)
    headers, path = _headers(), path.resolve()
    with tempfile.TemporaryDirectory(prefix="fmu-") as folder, contextlib.chdir(folder):
        files = builder.export_fmu({"no_warning": True, "with_serialization": False})
        _settle(Path("modelDescription.xml"), [Path(local) for local in files])
        binary = headers is not None and shutil.which("gcc") is not None
        if binary:
            files = builder.compile_fmu(files, {"include_dirs": [str(headers)]})
        path.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for local, inside in sorted(files.items(), key=lambda pair: pair[1]):
                entry = zipfile.ZipInfo(os.path.normpath(inside), date_time=EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, Path(local).read_bytes())
    return {"file": path.name, "binary": binary}


def _settle(description: Path, files: list[Path]) -> None:
    """Take the date out, and replace the random token by a digest of the model, wherever it
    stands."""
    text = re.sub(
        r' generationDateAndTime="[^"]*"', "", description.read_text(encoding="utf-8"), count=1
    )
    description.write_text(text, encoding="utf-8")
    found = re.search(r'instantiationToken="([^"]*)"', text)
    if found is None:
        return
    texts = {
        path: path.read_text(encoding="utf-8").replace(found[1], "TOKEN") for path in sorted(files)
    }
    digest = hashlib.sha256("".join(texts.values()).encode()).hexdigest()[:32]
    for path, settled in texts.items():
        path.write_text(settled.replace("TOKEN", digest), encoding="utf-8")


def _headers() -> Path | None:
    """The FMI 3 headers of an installed fmpy."""
    spec = importlib.util.find_spec("fmpy")
    if spec is None or spec.origin is None:
        return None
    folder = Path(spec.origin).parent / "c-code"
    return folder if (folder / "fmi3Functions.h").is_file() else None


def _builder(model: Exported) -> ca.DaeBuilder:
    """The model as a casadi.DaeBuilder. Its C has a function of the FMU's name, which must not be one
    of the C library's (`sin`)."""
    dae = ca.DaeBuilder(f"{model.name}_fmu")
    dae.add("time", "independent", {})
    n = model.own_states

    def described(name: str) -> str:
        return f"[{model.units.get(name, '-')}]"

    states = [
        dae.add(
            name,
            "local",
            "continuous",
            {"start": float(v), "initial": "exact", "description": described(name)},
        )
        for name, v in zip(model.states[:n], model.reference_state)
    ]
    inputs = [
        dae.add(name, "input", {"start": float(v), "description": described(name)})
        for name, v in zip(model.inputs, model.reference_inputs)
    ]
    parameters = [
        dae.add(name, "parameter", "tunable", {"start": float(v), "description": described(name)})
        for name, v in zip(model.parameters, model.parameter_values)
    ]
    outputs = [
        dae.add(f"y.{name}", "output", "continuous", {"description": described(name)})
        for name in model.outputs
    ]
    x, u = ca.vertcat(*states), ca.vertcat(*inputs)
    p = ca.vertcat(ca.MX(0, 1), *parameters)
    slope, seen = model["f"](x, u, p), model["h"](model.with_history(x, u), u, p)
    for i, state in enumerate(states):
        dae.eq(dae.der(state), slope[i])
    for i, output in enumerate(outputs):
        dae.eq(output, seen[i])
    return dae
