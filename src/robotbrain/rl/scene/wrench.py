"""External forces and torques on an articulation's bodies."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from robotbrain.rl.scene.world import EnvIds, World

Tensor = torch.Tensor
Ids = slice | torch.Tensor | Sequence[int] | None


class WrenchComposer:
    """Forces and torques on bodies that last until they are set again or their environment is reset.

    Args:
        world: the simulations.
        body_ids: MuJoCo's ids of the bodies.
    """

    def __init__(self, world: World, body_ids: Tensor) -> None:
        self._world, self._bodies = world, body_ids
        self._wrench = torch.zeros(world.num_envs, len(body_ids), 6)
        self._active = False

    def set_forces_and_torques_index(
        self,
        forces: Tensor | None = None,
        torques: Tensor | None = None,
        *,
        body_ids: Ids = None,
        env_ids: EnvIds = None,
    ) -> None:
        """Replace the forces [N] and torques [N m] of these environments, (n, bodies, 3) each.

        They act at the bodies' centres of mass and are given in the bodies' frames. Bodies that are not named get none.
        """
        rows = torch.from_numpy(self._world.ids(env_ids))
        columns = torch.arange(len(self._bodies))
        if body_ids is not None:
            columns = columns[body_ids if isinstance(body_ids, slice) else torch.as_tensor(body_ids)]
        self._wrench[rows] = 0.0
        for part, values in ((slice(0, 3), forces), (slice(3, 6), torques)):
            if values is not None:
                self._wrench[rows.unsqueeze(1), columns, part] = values.to(self._wrench.dtype)
        self._activate()

    def reset(self, env_ids: EnvIds = None) -> None:
        """Take the forces and torques of these environments away."""
        if self._active:
            self._wrench[torch.from_numpy(self._world.ids(env_ids))] = 0.0

    def state_dict(self) -> dict[str, Tensor]:
        """What a later run needs to continue."""
        return {"wrench": self._wrench.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from :meth:`state_dict`."""
        self._wrench.copy_(state["wrench"])
        if self._wrench.any():
            self._activate()

    def _activate(self) -> None:
        if not self._active:
            self._active = True
            self._world.before_step.append(self._apply)

    def _apply(self) -> None:
        world = self._world
        rotation = torch.from_numpy(world.derived("xmat"))[:, self._bodies].view(world.num_envs, -1, 3, 3)
        turned = rotation @ self._wrench.double().view(world.num_envs, -1, 2, 3).transpose(-1, -2)
        world.batch.bind("xfrc_applied")[:, self._bodies.numpy()] = turned.transpose(-1, -2).flatten(-2).numpy()
