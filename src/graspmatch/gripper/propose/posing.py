"""The hand while nothing is known of it but its joints: where links and tips are for any values of the driven ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.errors import GraspmatchError
from graspmatch.geometry.mesh import face_normals_areas
from graspmatch.geometry.se3 import apply, from_parts, inverse
from graspmatch.gripper.card import Card, DrivenJoint, PreshapeRule, SampleRule
from graspmatch.gripper.description import Description, describe
from graspmatch.gripper.kinematics import HandModel, assemble, solve_posture
from graspmatch.gripper.propose.drives import Drives
from graspmatch.gripper.propose.tree import Branch, Tree

Array = np.ndarray

UNLIMITED = np.pi / 2
"""What a hinge without limits, or with limits beyond it, is moved both ways from its zero [rad]."""
NEAR_TIP = 0.4
"""Share of a finger's length from its tip on in which it holds things."""
TIP_SHARE = 0.15
"""Share of the last link's length that counts as the tip."""


@dataclass(frozen=True)
class Shape:
    """Points spread over the surface of a link, in its own frame."""

    points: Float[Array, "n 3"]
    """[m]"""
    areas: Float[Array, "n"]
    """What each stands for [m2]."""


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A hand with all its driven joints, and no word yet on what they are for."""

    hand: HandModel
    tree: Tree
    branches: tuple[Branch, ...]
    """One for each finger."""
    lower: Float[Array, "d"]
    """Sensible limits of the driven joints [rad or m]."""
    upper: Float[Array, "d"]
    home: Float[Array, "d"]
    """The description's zero, within the limits."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The driven joints."""
        return self.hand.joint_names

    @property
    def description(self) -> Description:
        """What the file says."""
        return self.hand.description

    @cached_property
    def shapes(self) -> tuple[Shape, ...]:
        """Of every link with geometry."""
        return tuple(_shape(link.collision) for link in self.hand.links)

    def links_of(self, bodies: tuple[int, ...]) -> list[int]:
        """Indices of the links with geometry among some bodies."""
        return [i for i, body in enumerate(self.description.link_bodies) if body in bodies]

    def outer_links(self, branch: Branch) -> list[int]:
        """The links of a finger that do not hang on the palm directly: those that do may slide or turn inside of it."""
        model, bodies = self.description.model, self.description.link_bodies
        return [i for i in self.links_of(branch.bodies) if _joints_before(model, bodies[i], branch) > 1]

    def pose(self, driven: Float[Array, "d"]) -> Float[Array, "l 4 4"]:
        """T_base_link of every link with geometry."""
        data = self._posed(driven)
        bodies = [self.description.base_body, *self.description.link_bodies]
        T_world_body = from_parts(data.xmat[bodies].reshape(-1, 3, 3), data.xpos[bodies])
        return inverse(T_world_body[0]) @ T_world_body[1:]

    def joint_axes(self, driven: Float[Array, "d"]) -> tuple[Float[Array, "j 3"], Float[Array, "j 3"]]:
        """Anchor [m] and axis of every joint of the model, frame of the base."""
        data, base = self._posed(driven), self.description.base_body
        T_base_world = inverse(from_parts(data.xmat[base].reshape(3, 3), data.xpos[base]))
        return apply(T_base_world, data.xanchor), data.xaxis @ T_base_world[:3, :3].T

    def _posed(self, driven: Float[Array, "d"]) -> mujoco.MjData:
        """The engine's state in a posture, valid until the next one."""
        if self._law is None:
            self._state.qpos[:] = solve_posture(self.hand, driven)
        else:
            slope, offset = self._law
            self._state.qpos[:] = slope @ driven + offset
        mujoco.mj_kinematics(self.description.model, self._state)
        return self._state

    @cached_property
    def _state(self) -> mujoco.MjData:
        return mujoco.MjData(self.description.model)

    @cached_property
    def _law(self) -> tuple[Float[Array, "q d"], Float[Array, "q"]] | None:
        """How all joints follow from the driven ones if couplings are linear, which is much faster; else none."""
        middle = (self.lower + self.upper) / 2
        step = 0.1 * (self.upper - self.lower)
        try:
            centre = solve_posture(self.hand, middle)
            columns = [(solve_posture(self.hand, middle + d) - centre) / d.max() for d in np.diag(step)]
            slope = np.stack(columns, axis=1)
            tried = np.random.default_rng(0).uniform(self.lower, self.upper, (3, len(middle)))
            misses = [solve_posture(self.hand, q) - (centre + slope @ (q - middle)) for q in tried]
        except GraspmatchError:
            return None
        return (slope, centre - slope @ middle) if np.abs(misses).max() < 1e-6 else None

    def points(self, links: list[int], T_base_link: Float[Array, "l 4 4"]) -> Float[Array, "n 3"]:
        """Surface points of some links [m], frame of the base."""
        if not links:
            return np.zeros((0, 3))
        return np.concatenate([apply(T_base_link[i], self.shapes[i].points) for i in links])

    def vertices(self, links: list[int], T_base_link: Float[Array, "l 4 4"]) -> Float[Array, "n 3"]:
        """Corners of some links [m], frame of the base."""
        return np.concatenate([apply(T_base_link[i], self.hand.links[i].collision.vertices) for i in links])

    @cached_property
    def palm_links(self) -> list[int]:
        """The palm itself; what stands behind it where it has no geometry."""
        return self.links_of(self.tree.palm) or self.links_of(self.tree.behind)

    @cached_property
    def palm_centre(self) -> Float[Array, "3"]:
        """Centre of the palm's surface at home, or of the fingers' roots where there is none [m]."""
        links, T = self.palm_links, self.pose(self.home)
        if links:
            areas = np.concatenate([self.shapes[i].areas for i in links])
            return np.average(self.points(links, T), axis=0, weights=areas)
        anchors, _ = self.joint_axes(self.home)
        return anchors[[branch.joints[0] for branch in self.branches]].mean(axis=0)

    @cached_property
    def tips(self) -> tuple[tuple[int, Float[Array, "n 3"]], ...]:
        """Of each finger the link that ends it, and the surface points at its end in that link's frame [m]."""
        return tuple(self._tip(branch) for branch in self.branches)

    def tip_positions(self, T_base_link: Float[Array, "l 4 4"]) -> Float[Array, "f 3"]:
        """Middle of each fingertip [m]."""
        return np.stack([apply(T_base_link[link], points.mean(axis=0)[None])[0] for link, points in self.tips])

    def tip_points(self, T_base_link: Float[Array, "l 4 4"]) -> list[Float[Array, "_ 3"]]:
        """Surface points of each fingertip [m]."""
        return [apply(T_base_link[link], points) for link, points in self.tips]

    def holding_points(self, finger: int, T_base_link: Float[Array, "l 4 4"]) -> Float[Array, "n 3"]:
        """Surface points of a finger in the part that holds things [m]."""
        points = self.points(self.links_of(self.branches[finger].bodies), T_base_link)
        away = np.linalg.norm(points - self.tip_positions(T_base_link)[finger], axis=-1)
        return points[away <= NEAR_TIP * away.max()]

    def _tip(self, branch: Branch) -> tuple[int, Float[Array, "n 3"]]:
        """The far end of the link that reaches farthest from the palm along its finger."""
        links, T = self.links_of(branch.bodies), self.pose(self.home)
        depth = [_joints_before(self.description.model, self.description.link_bodies[i], branch) for i in links]
        outer = [i for i, d in zip(links, depth, strict=True) if d == max(depth)]
        anchors, _ = self.joint_axes(self.home)
        model = self.description.model
        origin = self.palm_centre
        last = _last_joint(model, self.description.link_bodies[outer[0]])
        if last >= 0 and model.jnt_type[last] == mujoco.mjtJoint.mjJNT_HINGE and len(branch.joints) > 1:
            origin = anchors[last]
        reach = {i: np.linalg.norm(self.points([i], T) - origin, axis=-1) for i in outer}
        tip = max(outer, key=lambda i: reach[i].max())
        farthest, nearest = reach[tip].max(), reach[tip].min()
        return tip, self.shapes[tip].points[reach[tip] >= farthest - TIP_SHARE * max(farthest - nearest, 1e-3)]


def mechanism(model: mujoco.MjModel, files: tuple[Path, ...], tree: Tree, drives: Drives) -> Mechanism:
    """The hand with its driven joints free to move, linkages that move together taken as one finger."""
    description = describe(model, files, model.body(tree.base).name)
    names = [model.joint(j).name for j in drives.driven]
    home = model.qpos0[model.jnt_qposadr[drives.driven]]
    card = _blank_card(description, dict(zip(names, home.tolist(), strict=True)), drives)
    hand = assemble(card, description)
    is_hinge = model.jnt_type[drives.driven] == mujoco.mjtJoint.mjJNT_HINGE
    free = np.where(is_hinge, UNLIMITED, 0.05)
    lower = np.where(np.isfinite(hand.lower), hand.lower, home - free)
    upper = np.where(np.isfinite(hand.upper), hand.upper, home + free)
    fingers = tuple(b for b in tree.branches if any(body in description.link_bodies for body in b.bodies))
    found = Mechanism(hand, tree, fingers, lower, upper, np.clip(home, lower, upper))
    return found


def _blank_card(description: Description, joints: dict[str, float], drives: Drives) -> Card:
    """A card that drives every joint and says nothing else."""
    return Card(
        path=description.path,
        name=description.path.stem,
        title="",
        description=str(description.path),
        source="",
        base_link=description.base_link,
        approach=np.array([0.0, 0.0, 1.0]),
        closing=np.array([1.0, 0.0, 0.0]),
        tool_centre_point=np.zeros(3),
        finger_force=1.0,
        self_locking=False,
        opening=1.0,
        palm=(),
        joints={name: DrivenJoint(value, None) for name, value in joints.items()},
        couplings=drives.named(description.model),
        fingers=(),
        preshapes=PreshapeRule(0, (0.0, 0.0), {}, {}, fingertips=0),
        samples=SampleRule("mesh", 0.005),
    )


def _shape(mesh) -> Shape:
    """Up to a few hundred points, spread by area."""
    _, areas = face_normals_areas(mesh)
    count = 400
    cumulative = np.cumsum(areas)
    rng = np.random.default_rng(0)
    index = np.searchsorted(cumulative, (np.arange(count) + 0.5) / count * cumulative[-1])
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[np.minimum(index, len(areas) - 1)]], 1, 0)
    return Shape(a + u * (b - a) + v * (c - a), np.full(count, cumulative[-1] / count))


def _joints_before(model: mujoco.MjModel, body: int, branch: Branch) -> int:
    """How many joints of a finger lie between the palm and a body."""
    count = 0
    while body in branch.bodies:
        count += int(model.body_jntnum[body])
        body = int(model.body_parentid[body])
    return count


def _last_joint(model: mujoco.MjModel, body: int) -> int:
    """The joint nearest to a body on its way to the root, -1 if there is none."""
    while body > 0 and not model.body_jntnum[body]:
        body = int(model.body_parentid[body])
    return int(model.body_jntadr[body] + model.body_jntnum[body] - 1) if body > 0 else -1
