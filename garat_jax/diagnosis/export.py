"""Write a model card as plain MJCF, and say what MJCF cannot."""

import os
import shutil
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from garat_jax.diagnosis.model_card import Model, check_model
from garat_jax.effects import Effect, in_order
from garat_jax.effects.joint import TorqueOffset
from garat_jax.effects.motor_apart import Transmission
from garat_jax.errors import UserError
from garat_jax.files import written_whole


class Exported(NamedTuple):
    """A plain MJCF file.

    Attributes:
        path: The file.
        unsaid: What MJCF cannot say, or MJX does not step, one line each.
    """

    path: Path
    unsaid: tuple[str, ...]


def export_mjcf(model: Model, path: str | Path) -> Exported:
    """Write a model with its overrides and effects as one MJCF file.

    Included files become part of it; meshes and textures stay where they are and are named
    relative to it. MuJoCo writes numbers with six digits.

    Args:
        model: The model.
        path: The MJCF file.

    Raises:
        UserError: The file is one that the model is made of, or MuJoCo cannot compile or read back
            what was written.
    """
    check_model(model)
    path = Path(path)
    if path.resolve() in (model.path.resolve(), model.mjcf.resolve()):
        raise UserError(f"{path} is what the model is made of; give another name")
    spec = model.spec.copy()
    for override in model.overrides:
        override.apply(spec)
    _write_out(spec)
    unsaid = tuple(
        line if effect.kind in line else f"{effect.kind} at {effect.target}: {line}"
        for effect in sorted(in_order(model.effects), key=_turn)
        if (line := effect.export(spec))
    )
    _point_at_assets(spec, model.mjcf.parent, path.parent)
    try:
        spec.compile()
        text = spec.to_xml()
    except ValueError as error:
        raise UserError(f"MuJoCo cannot compile the model: {error}") from error
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
        try:
            mujoco.MjModel.from_xml_path(str(temporary))
        except ValueError as error:
            raise UserError(
                f"{path}: MuJoCo cannot read the model back: {' '.join(str(error).split())}"
            ) from error
    return Exported(path, unsaid)


def _write_out(spec: mujoco.MjSpec) -> None:
    """Write what the compiler makes of a springdamper and a dampratio in their place.

    They would overwrite an effect's stiffness and damping, or follow an effect's masses.
    """
    host = spec.copy().compile()
    for joint in spec.joints:
        if joint.name and np.any(joint.springdamper):
            compiled = host.joint(joint.name)
            joint.stiffness[0], joint.damping[0] = compiled.stiffness[0], compiled.damping[0]
            joint.springdamper = [0.0, 0.0]
    for actuator, bias in zip(spec.actuators, host.actuator_biasprm, strict=True):
        actuator.biasprm[:] = bias


def _turn(effect: Effect) -> int:
    """Sort motors that leave their joint first: what else is at the joint stays there.

    A torque that an actuator's bias stands for comes last, when its gain and limit are final.
    """
    return 0 if isinstance(effect, Transmission) else 2 if isinstance(effect, TorqueOffset) else 1


def needed_files(model: Model) -> list[Path]:
    """List a model's MJCF file and all files that it needs, relative to its folder.

    Raises:
        UserError: The model needs a file outside the folder of its MJCF.
    """
    source = model.mjcf.parent.resolve()
    files = [Path(name).resolve() for name in mujoco.mju_getXMLDependencies(str(model.mjcf))]
    outside = [file for file in files if not file.is_relative_to(source)]
    if outside:
        above = Path(os.path.commonpath([source, *outside]))
        raise UserError(
            f"{model.mjcf} needs {outside[0]}, outside its folder, so it cannot be copied; give "
            f"the model that garat export {model.path} --out {above / model.mjcf.name} writes"
        )
    return [file.relative_to(source) for file in files]


def copy_model(model: Model, folder: Path) -> Path:
    """Copy a model's MJCF file and all files that it needs into a folder, and return its path.

    Raises:
        UserError: The model needs a file outside the folder of its MJCF.
    """
    for file in needed_files(model):
        target = folder / file
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(model.mjcf.parent / file, target)
    return folder / model.mjcf.name


def _point_at_assets(spec: mujoco.MjSpec, source: Path, target: Path) -> None:
    """Name the folders of meshes and textures relative to where the file will lie."""
    for field in ("meshdir", "texturedir"):
        folder = (source / (getattr(spec.compiler, field) or ".")).resolve()
        setattr(spec.compiler, field, Path(os.path.relpath(folder, target.resolve())).as_posix())
    spec.modelfiledir = str(target.resolve())
