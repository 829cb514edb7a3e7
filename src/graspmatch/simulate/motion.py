"""One run of a simulated world: the base follows its way, the fingers close, frames are taken."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float

from graspmatch.simulate.stroke import Stroke, stroke_from
from graspmatch.simulate.world import World, body_pose, object_pose

Array = np.ndarray

PLAY = {int(mujoco.mjtJoint.mjJNT_SLIDE): 1e-5, int(mujoco.mjtJoint.mjJNT_HINGE): 1e-4}
"""Of a joint that is held in place [m, rad]."""
BACKLASH = {int(mujoco.mjtJoint.mjJNT_SLIDE): 5e-4, int(mujoco.mjtJoint.mjJNT_HINGE): 1e-2}
"""How far a self-locking drive gives way before it locks [m, rad]: more than a finger rebounds when it lands, or the
blow would stay locked in as a squeeze far above the rated force."""
AT_REST = 0.02
"""A drive that is slower than this share of its speed has stopped."""


@dataclass(eq=False)
class Recording:
    """The poses of a run, frame by frame."""

    frames_per_second: int = 25
    clock: float = 0.0
    """Of the run so far; the engine's own is turned back by protocols that try several things from one state [s]."""
    times: list[float] = field(default_factory=list)
    """[s]"""
    phases: list[str] = field(default_factory=list)
    T_world_link: list[Float[Array, "l 4 4"]] = field(default_factory=list)
    """Of the gripper's links."""
    T_world_object: list[Float[Array, "4 4"]] = field(default_factory=list)

    def take(self, world: World, data: mujoco.MjData, phase: str) -> None:
        """A frame, if it is time for one: to be called after each time step."""
        self.clock += world.model.opt.timestep
        if self.clock < len(self.times) / self.frames_per_second - 1e-9:
            return
        self.times.append(self.clock)
        self.phases.append(phase)
        self.T_world_link.append(np.stack([body_pose(data, body) for body in world.link_bodies]))
        self.T_world_object.append(object_pose(world, data))


@dataclass(eq=False)
class Run:
    """A world in motion. All motions are generators of one time step each, so that the caller can watch and stop."""

    world: World
    data: mujoco.MjData
    recording: Recording | None = None
    phase: str = "approach"
    base: Float[Array, "3"] = field(default_factory=lambda: np.zeros(3))
    """Where the base shall be, from where it was placed [m]."""
    stroke: Stroke = field(init=False)
    """How the fingers close from here."""
    speed: Float[Array, "d"] = field(init=False)
    """Of the driven joints when nothing is in their way; zero: locked."""
    is_closing: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        self.stroke = stroke_from(self.world.hand, self.data.qpos[self.world.drive_qpos])
        self.hold_fingers()

    def step(self) -> None:
        """One time step."""
        mujoco.mj_step(self.world.model, self.data)
        if self.is_closing and self.world.hand.card.self_locking:
            self._advance_ratchets()
        if self.recording is not None:
            self.recording.take(self.world, self.data, self.phase)

    @property
    def is_broken(self) -> bool:
        """Whether the engine has given up on the state, which it then resets."""
        return any(warning.number for warning in self.data.warning)

    def wait(self, seconds: float) -> Iterator[None]:
        """Stay and go on squeezing."""
        for _ in range(round(seconds / self.world.model.opt.timestep)):
            self.step()
            if self.is_broken:
                return
            yield

    def move(self, way: Float[Array, "3"], seconds: float) -> Iterator[None]:
        """Move the base straight along `way` [m], from rest to rest."""
        world, start = self.world, self.base
        lead = world.base_gain[:3, 1] / world.base_gain[:3, 0]  # the servos damp all velocity, what is wanted too
        steps = round(seconds / world.model.opt.timestep)
        for turn in 2 * np.pi * np.arange(1, steps + 1) / steps:
            self.base = start + (turn - np.sin(turn)) / (2 * np.pi) * way
            velocity = (1 - np.cos(turn)) * way / seconds
            self.data.ctrl[world.base_servo[:3]] = self.base + lead * velocity
            self.step()
            if self.is_broken:
                return
            yield

    def close(self, seconds: float, *, squeeze: float) -> Iterator[None]:
        """Close the fingers at the speed that takes them from open to closed in `seconds`, until they are at rest.

        They are given twice the time, and squeeze for `squeeze` seconds more.
        """
        world = self.world
        self._release_fingers(seconds)
        moving, quiet = self.speed != 0, 0.0
        step = world.model.opt.timestep
        for _ in range(round(2 * seconds / step)):
            self.step()
            velocity = self.data.qvel[world.drive_dof[moving]]
            at_rest = bool(np.all(np.abs(velocity) < AT_REST * np.abs(self.speed[moving])))
            quiet = quiet + step if at_rest else 0.0
            yield
            if quiet > squeeze / 2 or self.is_broken:
                break
        yield from self.wait(squeeze)
        self.is_closing = False

    def hold_fingers(self) -> None:
        """Lock every driven joint where it is."""
        world, data = self.world, self.data
        for joint, qpos in zip(world.drive_joint, world.drive_qpos, strict=True):
            play = PLAY[int(world.model.jnt_type[joint])]
            world.model.jnt_range[joint] = data.qpos[qpos] - play, data.qpos[qpos] + play
        data.ctrl[world.drive_motor[world.drive_motor >= 0]] = 0
        world.model.dof_damping[world.drive_dof] = 0
        self.speed = np.zeros(len(world.drive_joint))

    def _release_fingers(self, seconds: float) -> None:
        """Let the closing joints go to the card's closed posture, or back as far as the drives allow."""
        world, card, stroke = self.world, self.world.hand.card, self.stroke
        self.speed, self.is_closing = stroke.way / seconds, True
        for i in np.flatnonzero(self.speed):
            held = self.data.qpos[world.drive_qpos[i]]
            back = held if card.self_locking else world.drive_range[i, 0 if self.speed[i] > 0 else 1]
            world.model.jnt_range[world.drive_joint[i]] = sorted((back, stroke.end[i]))
            # The line of a motor: the rated force at rest, none at full speed.
            world.model.dof_damping[world.drive_dof[i]] = stroke.force[i] / abs(self.speed[i])
            self.data.ctrl[world.drive_motor[i]] = np.sign(self.speed[i]) * stroke.force[i]
        self._tie_followers()

    def _tie_followers(self) -> None:
        """The joints of each finger keep the proportion of their ways."""
        world, model = self.world, self.world.model
        self.data.eq_active[world.synergies] = 0
        for e, (follower, (lead, ratio)) in zip(world.synergies, self.stroke.followers.items(), strict=False):
            joints = [world.drive_joint[i] for i in (follower, lead)]
            home, here = (q[model.jnt_qposadr[joints]] for q in (model.qpos0, self.data.qpos))
            model.eq_obj1id[e], model.eq_obj2id[e] = joints
            model.eq_data[e, :5] = (here - home)[0] - ratio * (here - home)[1], ratio, 0, 0, 0
            self.data.eq_active[e] = 1

    def _advance_ratchets(self) -> None:
        """What cannot be pushed back keeps what it has closed, but for the backlash."""
        model = self.world.model
        for i in np.flatnonzero(self.speed):
            joint, sign = self.world.drive_joint[i], np.sign(self.speed[i])
            locked = self.data.qpos[self.world.drive_qpos[i]] - sign * BACKLASH[int(model.jnt_type[joint])]
            side = 0 if sign > 0 else 1
            model.jnt_range[joint, side] = sign * max(sign * model.jnt_range[joint, side], sign * locked)
