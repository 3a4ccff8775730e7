"""Objects and the table as bodies of a MuJoCo model."""

from __future__ import annotations

from typing import Any

from handtrack.objects.rigid_object import RigidObject
from handtrack.optional import import_extra

TABLE_FRICTION = 0.6
"""Sliding friction of the table's top."""

TABLE_ROLLING = 0.001
"""Rolling resistance of the table's top [m]: a cloth, on which an apple stays where it is put."""


def add_object(
    spec: Any,
    thing: RigidObject,
    *,
    name: str,
    twist: tuple[float, float],
    contact: dict[str, Any],
) -> None:
    """Add a free body with the object's collision pieces, mass and friction.

    Args:
        spec: The `mujoco.MjSpec` being built.
        thing: The object.
        name: Name of its body.
        twist: Torsional and rolling friction of a contact with it [m].
        contact: MuJoCo's settings of its contacts.
    """
    mujoco = import_extra("mujoco", "physics", "simulating objects")
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    inertia = thing.inertia
    body.explicitinertial = True
    body.mass, body.ipos = thing.mass, (0.0, 0.0, 0.0)
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    settings = {
        # Its own friction counts, not the larger of the two, whatever touches it.
        "priority": 1, "friction": (thing.friction, *twist),
        "rgba": (0.36, 0.55, 0.71, 1.0), **contact,
    }  # fmt: skip
    if thing.primitive is not None:
        kinds = {
            "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
            "box": mujoco.mjtGeom.mjGEOM_BOX,
            "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
            "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
        }
        size = [*thing.primitive.size, 0.0, 0.0][:3]
        body.add_geom(name=name, type=kinds[thing.primitive.kind], size=size, **settings)
        return
    for k, corners in enumerate(thing.pieces):
        spec.add_mesh(name=f"{name}_{k}", uservert=corners.ravel())
        body.add_geom(
            name=f"{name}_{k}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{name}_{k}", **settings
        )


def add_table(spec: Any, *, contact: dict[str, Any]) -> None:
    """Add the table: the plane z = 0."""
    mujoco = import_extra("mujoco", "physics", "simulating a table")
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(1.0, 1.0, 0.05),
        friction=(TABLE_FRICTION, 0.005, TABLE_ROLLING), priority=2, condim=6,
        rgba=(0.8, 0.8, 0.78, 1.0),
        solref=contact["solref"], solimp=contact["solimp"],
    )  # fmt: skip
    spec.worldbody.add_light(pos=(0.3, -0.5, 1.5), dir=(-0.2, 0.3, -1.0))
