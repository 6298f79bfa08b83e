"""Which asset of the scene a term works on, and which of its joints and bodies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from robotbrain.errors import InputError
from robotbrain.rl.configclass import MISSING, Config, configclass, did_you_mean

if TYPE_CHECKING:
    import torch

    from robotbrain.rl.scene.interactive_scene import InteractiveScene

    Ids = slice | list[int] | torch.Tensor


@configclass
class SceneEntityCfg(Config):
    """An entity of the scene by name, with a selection of its joints and bodies.

    Names are regular expressions that match a whole name. The managers resolve them once: afterwards ``joint_ids``
    and ``body_ids`` are a slice where several are evenly spaced in the asset (``slice(None)``: all), because that is
    the fastest index, else a ``torch.long`` tensor.

    Attributes:
        name: the entity's name in the scene configuration, e.g. ``"robot"`` or ``"contact_forces"``.
        joint_names, joint_ids: the joints; give one of the two.
        body_names, body_ids: the bodies (a contact sensor's: the bodies it senses); give one of the two.
        preserve_order: keep the order of the names given instead of the asset's.
    """

    name: str = MISSING
    joint_names: str | list[str] | None = None
    joint_ids: Any = slice(None)
    body_names: str | list[str] | None = None
    body_ids: Any = slice(None)
    preserve_order: bool = False

    def resolve(self, scene: InteractiveScene) -> None:
        """Turn names into indices (or indices into names).

        Raises:
            InputError: no such entity, joint or body, or names and indices that contradict each other.
        """
        if self.name not in scene.keys():  # noqa: SIM118  (a scene is no mapping)
            raise InputError(
                "SceneEntityCfg.name",
                given=self.name,
                expected="an entity of the scene",
                fix=did_you_mean(str(self.name), scene.keys()),
            )
        entity = scene[self.name]
        if self.joint_names is not None or not _is_all(self.joint_ids):
            self.joint_names, self.joint_ids = _resolve(
                self.joint_names, self.joint_ids, entity.find_joints, entity.joint_names, self.preserve_order
            )
        if self.body_names is not None or not _is_all(self.body_ids):
            self.body_names, self.body_ids = _resolve(
                self.body_names, self.body_ids, entity.find_bodies, entity.body_names, self.preserve_order
            )


def _is_all(ids: object) -> bool:
    return isinstance(ids, slice) and ids == slice(None)


def _resolve(names: Any, ids: Any, find: Any, all_names: list[str], preserve_order: bool) -> tuple[list[str], Any]:
    import torch

    given = None
    if not _is_all(ids):
        given = list(range(len(all_names))[ids]) if isinstance(ids, slice) else torch.as_tensor(ids).flatten().tolist()
        if not all(0 <= i < len(all_names) for i in given):
            raise InputError(
                "SceneEntityCfg ids",
                given=given,
                expected=f"indices in 0..{len(all_names) - 1}",
                fix="Give names instead of indices, or indices in this range.",
            )
    if names is None:
        found = given or []
    else:
        found, matched = find(names, preserve_order=preserve_order)
        if given is not None and given != found:
            raise InputError(
                "SceneEntityCfg",
                given={"names": names, "ids": given},
                expected=f"names and ids that agree; {matched} are {found}",
                fix="Give names or ids, not both.",
            )
    resolved = [all_names[i] for i in found]
    if found == list(range(len(all_names))):
        return resolved, slice(None)
    step = found[1] - found[0] if len(found) > 1 else 0
    if step > 0 and found == list(range(found[0], found[-1] + 1, step)):
        return resolved, slice(found[0], found[-1] + 1, step)
    return resolved, torch.tensor(found, dtype=torch.long)
