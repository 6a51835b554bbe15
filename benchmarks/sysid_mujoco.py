"""A quadrotor in MJCF whose numbers MuJoCo's own mujoco.sysid fits: `pip install 'mujoco[sysid]'`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.sysid_windows import (
    COMPARED,
    REFITS,
    SAME,
    START_LAG,
    Window,
    difference,
    numbers,
    rotors_at_start,
    scale_of,
)
from greybox.model.vehicle import Vehicle
from greybox.symbolic import FloatArray

BOX = np.ones((3, 3)) - np.eye(3)
"""Moments of inertia of second moments of mass: any of these that are positive belong to a body."""


class MuJoCoPeer:
    """A quadrotor in MJCF whose numbers mujoco.sysid fits."""

    def __init__(self, vehicle: Vehicle, dt: float, mass: float | None = None) -> None:
        import mujoco

        self.dt, self.count = dt, len(vehicle.rotors)
        self.values = numbers(vehicle)
        self.values["mass"] = mass or self.values["mass"]
        self.spec = mujoco.MjSpec.from_string(self._mjcf(vehicle))
        self.params = self._parameters()
        self.covariance = np.zeros((0, 0))

    def _mjcf(self, vehicle: Vehicle) -> str:
        v = self.values
        arm = np.abs([r.position for r in vehicle.rotors]).max()
        ratio = sum(v[f"torque.c{k}"] for k in range(3)) / sum(v[f"thrust.c{k}"] for k in range(3))
        sites = "".join(
            f'<site name="r{i}" pos="{" ".join(map(str, r.position))}"/>'
            for i, r in enumerate(vehicle.rotors)
        )
        motors = "".join(
            f'<general name="m{i}" site="r{i}" dyntype="filter" dynprm="{START_LAG}" gainprm="1" '
            'biastype="none" '
            f'gear="0 0 1 0 0 {-r.spin * ratio}"/>'
            for i, r in enumerate(vehicle.rotors)
        )
        moments = " ".join(str(v[f"inertia.{a}{a}"]) for a in "xyz")
        return (
            f'<mujoco><option integrator="RK4" timestep="{self.dt}" gravity="0 0 '
            f'{-float(vehicle.gravity)}" '
            'density="1.2" viscosity="1.8e-5"/><worldbody><body name="craft"><freejoint '
            'name="free"/>'
            f'<inertial pos="0 0 0" mass="{v["mass"]}" diaginertia="{moments}"/>'
            f'<geom type="box" size="{arm} {arm} {0.3 * arm}" contype="0" '
            f'conaffinity="0"/>{sites}</body></worldbody>'
            f"<actuator>{motors}</actuator></mujoco>"
        )

    def _parameters(self) -> Any:
        from mujoco import sysid

        model, found, rotors = self.spec.compile(), sysid.ParameterDict(), range(self.count)

        def add(
            name: str, value: Any, low: float, high: float, modifier: Callable[[Any, Any], None]
        ) -> None:
            start = np.atleast_1d(np.asarray(value, dtype=float))
            found.add(sysid.Parameter(name, start, low * start, high * start, modifier=modifier))

        def gain(spec: Any, p: Any) -> None:
            for i in rotors:
                spec.actuator(f"m{i}").gainprm[0] = p.value[i]

        def lag(spec: Any, p: Any) -> None:
            for i in rotors:
                spec.actuator(f"m{i}").dynprm[0] = p.value[0]

        def torque(spec: Any, p: Any) -> None:
            for i in rotors:
                gear = spec.actuator(f"m{i}").gear
                gear[5] = np.sign(gear[5]) * p.value[0]

        def moments(spec: Any, p: Any) -> None:
            spec.body("craft").inertia[:] = BOX @ p.value

        add("gain", np.ones(self.count), 0.3, 3.0, gain)
        add("lag", START_LAG, 0.1, 5.0, lag)
        add("torque", abs(model.actuator_gear[0, 5]), 0.2, 5.0, torque)
        # of the free joint, [N s/m] and [N m s/rad]; a damping of 1/s is where it starts from
        v = self.values
        add(
            "damping",
            [v["mass"], v["inertia.xx"], v["inertia.zz"]],
            0.0,
            50.0,
            lambda _spec, _p: None,
        )
        about = np.array([self.values[f"inertia.{a}{a}"] for a in "xyz"])
        add("inertia", np.linalg.solve(BOX, about), 0.1, 5.0, moments)
        return found

    def model(self, params: Any = None, spec: Any = None) -> Any:
        """The compiled model at these values, or the present ones."""
        from mujoco import sysid

        values = params or self.params
        model = sysid.apply_param_modifiers(values, spec or self.spec)
        along, around, yaw = values["damping"].value
        model.dof_damping[:] = [along] * 3 + [around] * 2 + [yaw]
        return model

    def starts(self, windows: Sequence[Window]) -> list[FloatArray]:
        """Initial states, rotors included: the commands of before through the lag."""
        from mujoco import sysid

        model, lag = self.model(), float(self.params["lag"].value[0])
        return [
            sysid.create_initial_state(
                model, w.measured[0, :7], w.measured[0, 7:], rotors_at_start(w, self.dt, lag)
            )
            for w in windows
        ]

    def fit(self, windows: Sequence[Window]) -> None:
        """Least squares over all windows, again until the rotors start by the lag that is found."""
        from mujoco import sysid

        scale, steps = scale_of(windows), len(windows[0].measured)
        times = self.dt * np.arange(steps)
        state = sysid.SignalType.MjStateQPos, sysid.SignalType.MjStateQVel
        layout = [("craft_qpos", 7, state[0]), ("craft_qvel", 6, state[1])]

        def errors(
            _p: Any, told: Any, seen: Any, _m: Any, _all: bool, *, state: Any, **_: Any
        ) -> tuple[Any, Any, Any]:
            return difference(state[:, 1:14], seen.data[1:]) / scale, told, told

        for _ in range(REFITS):
            before = float(self.params["lag"].value[0])
            sequence = sysid.ModelSequences(
                "craft",
                self.spec,
                [str(i) for i in range(len(windows))],
                self.starts(windows),
                [sysid.TimeSeries(times, w.commanded) for w in windows],
                [sysid.TimeSeries.from_custom_map(times, w.measured, layout) for w in windows],
                allow_missing_sensors=True,
            )
            residual = sysid.build_residual_fn(
                models_sequences=[sequence],
                build_model=self.model,
                modify_residual=errors,
                n_threads=1,
                resample_true=False,
            )
            self.params, result = sysid.optimize(self.params, residual, verbose=False, max_iters=40)
            if abs(float(self.params["lag"].value[0]) / before - 1.0) < SAME:
                break
        at_end = [np.ravel(r) for r in residual(self.params.as_vector(), self.params)[0]]
        self.covariance = np.asarray(sysid.calculate_intervals(at_end, np.asarray(result.jac))[0])

    def estimates(self) -> dict[str, dict[str, float]]:
        """Lag and moments of inertia of a box: value and std, as a table of a fit.json."""
        names = [n for n, p in self.params.items() for _ in range(p.size)]
        lag, box = names.index("lag"), [i for i, n in enumerate(names) if n == "inertia"]
        found = self.params.as_vector()
        moments = BOX @ found[box]
        spread = np.sqrt(np.diag(BOX @ self.covariance[np.ix_(box, box)] @ BOX.T))
        values = (float(found[lag]), *moments.tolist())
        errors = (float(self.covariance[lag, lag]) ** 0.5, *spread.tolist())
        return {n: {"value": v, "std": e} for n, v, e in zip(COMPARED, values, errors, strict=True)}

    def predict(self, windows: Sequence[Window]) -> FloatArray:
        """States (windows, H, 13)."""
        import mujoco
        from mujoco import rollout

        model = self.model()
        control = np.stack([w.commanded[:-1] for w in windows])
        states, _ = rollout.rollout(
            model, mujoco.MjData(model), np.stack(self.starts(windows)), control
        )
        return np.asarray(states[:, :, 1:14])
