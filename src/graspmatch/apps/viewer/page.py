"""The page: what the controls do to what is shown."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import viser

from graspmatch.apps.viewer import hands, marks, panel
from graspmatch.apps.viewer.forks import forks_at
from graspmatch.apps.viewer.motion import CLOSED, moment
from graspmatch.apps.viewer.palette import colours_of_scores
from graspmatch.apps.viewer.shown import Catalogue, Shown, planned
from graspmatch.apps.viewer.stage import Stage, set_stage
from graspmatch.errors import GraspmatchError
from graspmatch.types import GraspSet

FRAME_SECONDS = 0.04
"""Between two pictures of an animation [s] ..."""
GRASP_SECONDS, SEARCH_SECONDS = 4.0, 6.0
"""... and how long they take."""
GHOSTLY = 0.45
"""Opacity of the hands that are shown at once."""
FIELD_OF_VIEW = 0.7
"""Of the camera, from top to bottom [rad] ..."""
ROOM = 3.0
"""... and its distance, in halves of the size of what is shown."""


class Page:
    """One page, the same for all who look at it; `shown` is what they see, `panel` how they change it."""

    def __init__(self, server: viser.ViserServer, shown: Shown, catalogue: Catalogue, hand: str, scene: str) -> None:
        self.server, self.catalogue = server, catalogue
        self.panel = panel.add_panel(server, catalogue, hand, scene)
        self._lock = threading.RLock()
        self._playing: threading.Event | None = None
        self.show(shown)
        self._connect()

    def show(self, shown: Shown) -> None:
        """Take down what was shown and put this up, at the best grasp with its fingers closed."""
        with self._lock, self.server.atomic():
            self.shown = shown
            self._clear()
            self.server.scene.set_up_direction(shown.up)
            gripper, grasps = shown.hand.gripper, shown.grasps
            self.stage: Stage | None = None if shown.scene is None else set_stage(self.server, shown.scene)
            shape = hands.shape_of(shown.hand)
            self.colours = colours_of_scores(grasps.score)
            self.hand = hands.add_moving_hand(self.server, shape) if len(grasps) else None
            self.others = self._add_all(shape, grasps)
            _, self.search = shown.recording.particles()
            first = self.search[0] if len(self.search) else np.zeros((0, 4, 4))
            self.particles = marks.add_particles(self.server, gripper, first) if len(first) else None
            self.rejected = marks.add_rejected(self.server, gripper, shown.recording)
            self._set_controls()
            self._draw_all()
            self._aim()

    def _add_all(self, shape: hands.HandShape, grasps: GraspSet) -> list[viser.BatchedMeshHandle]:
        if not len(grasps):
            return []
        T_gripper_link = np.stack([self.shown.hand.link_poses(joints) for joints in grasps.grasp_joints])
        T_world_link = grasps.T_world_gripper[:, None] @ T_gripper_link
        return list(hands.add_many_hands(self.server, shape, T_world_link, self.colours, opacity=GHOSTLY))

    def _clear(self) -> None:
        for name in ("/object", "/obstacles", "/table", "/hand", "/hands", "/contacts", "/particles", "/rejected"):
            if self.server.scene.get_handle_by_name(name) is not None:
                self.server.scene.remove_by_name(name)

    def _set_controls(self) -> None:
        """Ranges and texts for what is shown now."""
        p, n, frames = self.panel, len(self.shown.grasps), len(self.search)
        p.grasp.max, p.also.max, p.iteration.max = max(n, 2), max(n, 1), max(frames - 1, 1)
        p.grasp.value, p.also.value, p.iteration.value, p.moment.value = 1, 0, 0, CLOSED
        for control in (p.grasp, p.moment, p.play, p.also):
            control.disabled = n == 0
        p.contacts.disabled = p.friction.disabled = not self.shown.contacts
        for control in (p.particles, p.iteration, p.play_search):
            control.disabled = frames == 0
        p.rejected.disabled = p.reason.disabled = not self.rejected
        p.reason.options = (panel.ALL_REASONS, *self.rejected)
        p.reason.value = panel.ALL_REASONS
        p.particles.value = p.rejected.value = False
        p.mesh.disabled = self.stage is None or self.stage.mesh is None
        p.cloud.disabled = self.stage is None
        p.mesh.value, p.cloud.value = not p.mesh.disabled, p.mesh.disabled
        p.summary.content = panel.summary_html(self.shown)
        p.legend.content = panel.legend_html(self.shown)

    def _connect(self) -> None:
        """Say what each control redraws."""
        p = self.panel
        redraws: list[tuple[viser.GuiInputHandle, Callable[[], None]]] = [
            (p.grasp, self._draw_grasp),
            (p.moment, self._draw_moment),
            (p.contacts, self._draw_contacts),
            (p.friction, self._draw_contacts),
            (p.also, self._draw_others),
            (p.mesh, self._draw_object),
            (p.cloud, self._draw_object),
            (p.particles, self._draw_particles),
            (p.iteration, self._draw_particles),
            (p.rejected, self._draw_rejected),
            (p.reason, self._draw_rejected),
        ]
        for control, draw in redraws:
            control.on_update(lambda _, draw=draw: self._redraw(draw))
        p.play.on_click(lambda _: self._play(p.moment, 0.0, 1.0, GRASP_SECONDS))
        p.play_search.on_click(lambda _: self._play_search())
        p.plan.on_click(lambda _: self.replan())

    def _redraw(self, draw: Callable[[], None]) -> None:
        with self._lock, self.server.atomic():
            draw()

    @property
    def index(self) -> int:
        """Of the grasp that is looked at."""
        return min(self.panel.grasp.value, len(self.shown.grasps)) - 1

    def _draw_all(self) -> None:
        self._draw_grasp()
        self._draw_object()
        self._draw_particles()
        self._draw_rejected()

    def _draw_grasp(self) -> None:
        if self.hand is not None:
            self.hand.paint(self.colours[self.index])
        self._draw_moment()
        self._draw_contacts()
        self._draw_others()

    def _draw_moment(self) -> None:
        if self.hand is None:
            self.panel.details.content = ""
            return
        now = moment(self.shown.grasps, self.index, self.panel.moment.value, self.shown.up)
        self.hand.move(now.T_world_gripper, self.shown.hand.link_poses(now.joints))
        if self.stage is not None:
            self.stage.object.position = now.lifted
        contacts = self.server.scene.get_handle_by_name("/contacts")
        if contacts is not None:
            contacts.position = now.lifted
        self.panel.details.content = panel.details_html(self.shown, self.index, now.phase)

    def _draw_contacts(self) -> None:
        if self.panel.contacts.value and self.shown.contacts and self.hand is not None:
            marks.draw_contacts(self.server, self.shown.contacts[self.index], self.panel.friction.value)
        else:
            marks.clear_contacts(self.server)
        self._draw_hand()

    def _draw_others(self) -> None:
        hands.show_first(self.others, self.panel.also.value, without=self.index)

    def _draw_object(self) -> None:
        if self.stage is not None:
            self.stage.cloud.visible = self.panel.cloud.value
            if self.stage.mesh is not None:
                self.stage.mesh.visible = self.panel.mesh.value

    def _draw_hand(self) -> None:
        """The hand and what it touches make room for those of the search."""
        searching = self.panel.particles.value or self.panel.rejected.value
        for node in (self.hand and self.hand.root, self.server.scene.get_handle_by_name("/contacts")):
            if node:
                node.visible = not searching

    def _draw_particles(self) -> None:
        self._draw_hand()
        if self.particles is None:
            return
        self.particles.visible = self.panel.particles.value
        if self.panel.particles.value:
            self.particles.points = forks_at(self.shown.hand.gripper, self.search[self.panel.iteration.value])

    def _draw_rejected(self) -> None:
        self._draw_hand()
        chosen = self.panel.reason.value
        for reason, node in self.rejected.items():
            node.visible = self.panel.rejected.value and chosen in (panel.ALL_REASONS, reason)

    def _aim(self) -> None:
        """Put the camera where all is seen; for those who come later too."""
        points = [self.shown.grasps.T_world_gripper[:, :3, 3]]
        if self.shown.scene is not None:
            points.append(self.shown.scene.target.points)
        seen = np.concatenate(points)
        if not len(seen):
            return
        low, high = seen.min(axis=0), seen.max(axis=0)
        middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 0.1)
        towards = np.array([0.75, -0.6, 0.35]) + 0.3 * self.shown.up
        place = middle + ROOM * size / 2 * towards / np.linalg.norm(towards)
        start = self.server.initial_camera
        start.up, start.fov, start.position, start.look_at = self.shown.up, FIELD_OF_VIEW, place, middle
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = place, middle

    def _play_search(self) -> None:
        self.panel.particles.value = True
        self._play(self.panel.iteration, 0, self.panel.iteration.max, SEARCH_SECONDS)

    def _play(self, slider: viser.GuiSliderHandle, first: float, last: float, seconds: float) -> None:
        """Move a slider from one end to the other; while one plays, the button stops it."""
        if self._playing is not None:
            self._playing.set()
            return
        self._playing = stop = threading.Event()
        begin = time.perf_counter()
        try:
            while not stop.wait(FRAME_SECONDS):
                share = min((time.perf_counter() - begin) / seconds, 1.0)
                slider.value = type(slider.value)(first + share * (last - first))
                if share >= 1.0:
                    break
        finally:
            self._playing = None

    def replan(self) -> None:
        """Plan for what the pickers say and show it; where that cannot be, say why."""
        p = self.panel
        p.plan.disabled = True
        p.status.content = panel.status_html(f"Planning for {p.scene.value} with {p.hand.value} ...")
        begin = time.perf_counter()
        try:
            shown = planned(self.catalogue, p.hand.value, p.scene.value, int(p.seed.value), int(p.count.value))
            self.show(shown)
            took = f"Planned in {time.perf_counter() - begin:.1f} s.\n{shown.grasps.explain()}"
            p.status.content = panel.status_html(took)
        except GraspmatchError as error:
            p.status.content = panel.status_html(str(error), is_bad=True)
        finally:
            p.plan.disabled = False
