"""How the fingers close from a posture: how fast, how hard, and which joints of a finger move as one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from graspmatch.geometry.se3 import apply
from graspmatch.gripper.card import closed_from
from graspmatch.gripper.kinematics import HandModel, pose_links

Array = np.ndarray


@dataclass(frozen=True)
class Stroke:
    """Of the d driven joints, from a posture to where its closing ends.

    The joints of a finger move in proportion, as its controller closes it: one leads with the force of the finger.
    """

    end: Float[Array, "d"]
    way: Float[Array, "d"]
    """In the time in which the hand closes from open [rad or m]; zero: does not move."""
    force: Float[Array, "d"]
    """[N or N m]; zero for joints that follow."""
    followers: dict[int, tuple[int, float]]
    """The joint that each follows, and how far for each unit of it."""


def stroke_from(hand: HandModel, start: Float[Array, "d"]) -> Stroke:
    """The stroke from some driven joint values."""
    card = hand.card
    end = closed_from(card, hand.joint_names, start)
    usual = card.closed_joints - card.open_joints
    fingers = [[card.joint_names.index(name) for name in finger.joints] for finger in card.fingers]
    if all(len(joints) == 1 for joints in fingers):  # the same from every posture
        way = np.where(end != start, usual, 0.0)
        return Stroke(end, way, np.where(way != 0, drive_forces(hand, card.open_joints, card.closed_joints), 0.0), {})
    motion, followers = end - start, {}
    way = np.zeros(len(motion))
    for joints in fingers:
        lead = leading_joint(motion, joints)
        if motion[lead] == 0:
            continue
        seconds = abs(motion[lead]) / max(abs(usual[lead]), 1e-9)
        for j in joints:
            way[j] = motion[j] / max(seconds, 1e-9)
            if j != lead and motion[j] != 0:
                followers[j] = (lead, float(motion[j] / motion[lead]))
    return Stroke(end, way, drive_forces(hand, start, end), followers)


def leading_joint(motion: Float[Array, "d"], joints: list[int]) -> int:
    """The joint of a finger that moves farthest."""
    return max(joints, key=lambda j: abs(motion[j]))


def drive_forces(hand: HandModel, start: Float[Array, "d"], end: Float[Array, "d"]) -> Float[Array, "d"]:
    """Force or torque [N or N m] of each joint that leads a finger, which presses its tip with the rated force.

    By virtual work, half way from `start` to `end`: the tip is the point of the finger that moves fastest, and moves by
    `lever` for each unit of the joint, couplings, linkages and following joints included. Zero for all other joints.
    """
    card = hand.card
    motion = end - start
    middle = start + motion / 2
    step = 1e-3
    link_of = {link.name: i for i, link in enumerate(hand.links)}
    forces = np.zeros(len(motion))
    for finger in card.fingers:
        driven = [card.joint_names.index(name) for name in finger.joints]
        lead = leading_joint(motion, driven)
        if motion[lead] == 0:
            continue
        links = [link_of[name] for name in finger.links]
        way = np.where(np.isin(np.arange(len(motion)), driven), motion, 0.0)
        velocity = _velocity(hand, links, middle, step * way) / (step * abs(motion[lead]))
        forces[lead] += card.finger_force * float(np.linalg.norm(velocity, axis=-1).max())
    return forces


def _velocity(
    hand: HandModel, links: list[int], driven: Float[Array, "d"], step: Float[Array, "d"]
) -> Float[Array, "v 3"]:
    """How far every vertex of some links moves over a step of the driven joints [m]."""
    before, after = pose_links(hand, driven - step / 2), pose_links(hand, driven + step / 2)
    meshes = [(i, hand.links[i].collision.vertices) for i in links]
    return np.concatenate([apply(after[i], vertices) - apply(before[i], vertices) for i, vertices in meshes])
