"""Contact forces and times of bodies that carry a MuJoCo touch sensor named ``contact_<body>``.

A touch sensor adds up the normal forces of the contacts inside its site's volume (the site has to enclose them). It
gives a magnitude, so only the z components of the forces are filled in: exact on level ground. The readings are those
of the last physics step of a control step; after a reset they are zero until the next step.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

from robotbrain.errors import InputError
from robotbrain.rl.configclass import did_you_mean
from robotbrain.rl.scene.names import find_names
from robotbrain.rl.scene.scene_cfg import ContactSensorCfg
from robotbrain.rl.scene.world import EnvIds, TensorView, World

PREFIX = "contact_"
_TOUCH = int(mujoco.mjtSensor.mjSENS_TOUCH)


class ContactSensorData:
    """Readings, each with a ``.torch``; B bodies.

    Attributes:
        net_normal_forces_w: (num_envs, B, 3) [N], only z is filled in; ``net_forces_w`` is the same.
        net_normal_forces_w_history: (num_envs, 1, B, 3) [N].
        force_magnitude: the readings themselves, (num_envs, B) [N].
        current_air_time, current_contact_time: since the last change, (num_envs, B) [s]; one of the two is zero.
        last_air_time, last_contact_time: of the phase before, (num_envs, B) [s].
    """

    def __init__(self, num_envs: int, num_bodies: int) -> None:
        self._forces = torch.zeros(num_envs, 1, num_bodies, 3)
        self._times = torch.zeros(4, num_envs, num_bodies)
        self.net_normal_forces_w_history = TensorView(self._forces)
        self.force_magnitude = TensorView(self._forces[:, 0, :, 2])
        self.net_normal_forces_w = TensorView(self._forces[:, 0])
        self.net_forces_w, self.net_forces_w_history = self.net_normal_forces_w, self.net_normal_forces_w_history
        self.current_air_time, self.last_air_time, self.current_contact_time, self.last_contact_time = (
            TensorView(t) for t in self._times
        )


class ContactSensor:
    """The contact sensor of a scene.

    Args:
        cfg: its configuration.
        world: the simulations.

    Raises:
        InputError: the model has no touch sensor named ``contact_...``.
    """

    def __init__(self, cfg: ContactSensorCfg, world: World) -> None:
        self.cfg, self._world = cfg, world
        model = world.model
        found = [s for s in range(model.nsensor) if model.sensor(s).name.startswith(PREFIX)]
        found = [s for s in found if int(model.sensor_type[s]) == _TOUCH]
        if not found:
            raise InputError(
                "ContactSensorCfg",
                given=[model.sensor(s).name for s in range(model.nsensor)],
                expected=f"touch sensors named {PREFIX}<body> in the model",
                fix=f"Add <touch name='{PREFIX}foot' site='...'/> to the model's sensors; the site encloses the foot.",
            )
        self.body_names: list[str] = [model.sensor(s).name.removeprefix(PREFIX) for s in found]
        address = np.array([int(model.sensor_adr[s]) for s in found])
        consecutive = (address - address[0] == np.arange(len(address))).all()
        self._columns: slice | np.ndarray = (
            slice(int(address[0]), int(address[0]) + len(address)) if consecutive else address
        )
        self.data = ContactSensorData(world.num_envs, len(found))
        # numpy views of the same memory: for arrays this small its calls cost a third of torch's
        self._force_z = self.data._forces.numpy()[:, 0, :, 2]
        self._air, self._last_air, self._contact, self._last_contact = self.data._times.numpy()
        shape = (world.num_envs, len(found))
        self._touching = np.zeros(shape, dtype=bool)
        self._ended, self._began = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self._first_contact = TensorView(torch.from_numpy(self._began))
        self._dt = 0.0

    @property
    def num_bodies(self) -> int:
        """Number of bodies sensed."""
        return len(self.body_names)

    @property
    def num_sensors(self) -> int:
        """Number of bodies sensed."""
        return len(self.body_names)

    def find_bodies(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> tuple[list[int], list[str]]:
        """Indices and names of the bodies whose whole name matches (regular expressions).

        Raises:
            InputError: a pattern matches nothing.
        """
        return find_names(name_keys, self.body_names, what="contact body", preserve_order=preserve_order)

    find_sensors = find_bodies

    def find_joints(self, name_keys: str | Sequence[str], preserve_order: bool = False) -> tuple[list[int], list[str]]:
        """A contact sensor has no joints.

        Raises:
            InputError: always.
        """
        raise InputError("joint_names", given=name_keys, expected="none for a sensor", fix=did_you_mean("", []))

    @property
    def joint_names(self) -> list[str]:
        """None: a sensor has no joints."""
        return []

    def update(self, dt: float) -> None:
        """Take over the readings after a step of ``dt`` seconds."""
        np.copyto(self._force_z, self._world.measured("sensordata")[:, self._columns], casting="same_kind")
        if not self.cfg.track_air_time:
            return
        air, contact, touching, ended = self._air, self._contact, self._touching, self._ended
        self._dt = dt
        np.greater(self._force_z, self.cfg.force_threshold, out=touching)
        np.equal(contact, 0.0, out=self._began)
        self._began &= touching
        np.greater(air, 0.0, out=ended)
        ended &= touching
        air += dt  # a phase that has just ended lasted until now
        np.copyto(self._last_air, air, where=ended)
        np.greater(contact, 0.0, out=ended)
        np.greater(ended, touching, out=ended)
        contact += dt
        np.copyto(self._last_contact, contact, where=ended)
        contact *= touching
        np.logical_not(touching, out=touching)
        air *= touching

    def reset(self, env_ids: EnvIds = None) -> None:
        """Forget forces and times."""
        ids = self._world.ids(env_ids)
        self.data._forces.numpy()[ids] = 0.0
        self.data._times.numpy()[:, ids] = 0.0
        self._began[ids] = False

    def compute_first_contact(self, dt: float, abs_tol: float = 1.0e-8) -> TensorView:
        """Which bodies came into contact within the last ``dt`` seconds, (num_envs, B) bool."""
        if dt == self._dt:
            return self._first_contact
        return TensorView(torch.from_numpy((self._contact > 0.0) & (self._contact < dt + abs_tol)))

    def compute_first_air(self, dt: float, abs_tol: float = 1.0e-8) -> TensorView:
        """Which bodies lost contact within the last ``dt`` seconds, (num_envs, B) bool."""
        return TensorView(torch.from_numpy((self._air > 0.0) & (self._air < dt + abs_tol)))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """What a later run needs to continue."""
        return {"forces": self.data._forces.clone(), "times": self.data._times.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Continue from :meth:`state_dict`."""
        self.data._forces.copy_(state["forces"])
        self.data._times.copy_(state["times"])
