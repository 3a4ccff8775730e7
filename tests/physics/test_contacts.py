"""Patches: one contact per bone, whose force and torque are those of its contacts together."""

from __future__ import annotations

import numpy as np
import pytest

from handtrack.physics.contacts import Contacts


def some_contacts(rng: np.random.Generator, bones: list[int]) -> Contacts:
    count = len(bones)
    normals = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Contacts(
        bones=np.array(bones, np.int64),
        points=np.array([0.4, -0.2, 0.3]) + 0.01 * rng.normal(size=(count, 3)),
        normals=normals,
        depths=0.001 * rng.normal(size=count),
        forces=normals + 0.3 * rng.normal(size=(count, 3)),
        torsions=0.001 * rng.normal(size=count),
    )


def test_a_patch_does_what_its_contacts_do(rng: np.random.Generator) -> None:
    contacts = some_contacts(rng, [3, 9, 3, 0, 9, 9, 12])
    patches = contacts.patches()
    assert patches.bones.tolist() == [0, 3, 9, 12]
    for k, bone in enumerate(patches.bones):
        own = contacts.bones == bone
        force = contacts.forces[own]
        np.testing.assert_allclose(patches.forces[k], force.sum(0), atol=1e-14)
        press = np.einsum("ni,ni->n", force, contacts.normals[own]).clip(min=0.0)
        centre = np.average(contacts.points[own], axis=0, weights=press)
        np.testing.assert_allclose(patches.points[k], centre, atol=1e-6)
        normal = np.average(contacts.normals[own], axis=0, weights=press)
        normal /= np.linalg.norm(normal)
        np.testing.assert_allclose(patches.normals[k], normal, atol=1e-5)
        moment = np.cross(contacts.points[own] - patches.points[k], force).sum(0)
        twist = moment @ patches.normals[k] + contacts.torsions[own].sum()
        np.testing.assert_allclose(patches.torsions[k], twist, atol=1e-12)
        assert patches.depths[k] == contacts.depths[own].max()


def test_a_patch_that_does_not_press_lies_amid_its_contacts(rng: np.random.Generator) -> None:
    contacts = some_contacts(rng, [5, 5])
    contacts.forces[:] = 0.0
    patches = contacts.patches()
    np.testing.assert_allclose(patches.points[0], contacts.points.mean(0))
    assert np.linalg.norm(patches.normals[0]) == pytest.approx(1.0)


def test_no_contact_is_no_patch(rng: np.random.Generator) -> None:
    patches = some_contacts(rng, []).patches()
    assert len(patches) == 0 and patches.points.shape == (0, 3) and patches.depths.shape == (0,)
