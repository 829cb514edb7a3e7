"""`graspmatch view` and `plan --view`: a page on this machine that shows grasps and plans others."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from graspmatch.apps.grasp_file import hand_and_grasps
from graspmatch.apps.hand import Hand, load_hand
from graspmatch.apps.options import View
from graspmatch.apps.speech import Speech
from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError
from graspmatch.gripper.zoo import known_grippers
from graspmatch.planner.recording import Recording
from graspmatch.scene.scene import Scene

if TYPE_CHECKING:
    from graspmatch.apps.viewer.page import Page
    from graspmatch.apps.viewer.shown import Catalogue, Shown

HOST = "127.0.0.1"
FIRST_PORT = 8080


def view(command: View, table: float | Literal["auto"] | None, say: Speech) -> int:
    """Show the grasps of a file until the user ends it; the result is the exit status."""
    check_library()
    hand, grasps = hand_and_grasps(command.grasps, command.gripper, command.description, command.config, say)
    scene = None
    if command.object is not None:
        with say.progress(f"Reading {command.object.name}"):
            scene = Scene.read(command.object, table=table, unit=command.unit)
    from graspmatch.apps.viewer.shown import shown_of

    with say.progress("Making the page ready"):
        shown = shown_of(hand, grasps, scene, Recording(), command.config.device)
    return serve(shown, command.config, say, {"grasps": len(grasps)}, port=command.port)


def serve(shown: Shown, config: PlannerConfig, say: Speech, record: dict[str, Any], *, port: int = FIRST_PORT) -> int:
    """Serve a page on this machine only, until the user ends it; the result is the exit status.

    With `--json` the record is printed once the page is up, its address with it.
    """
    with page_of(shown, config, port=port) as page, suppress(KeyboardInterrupt):
        url = f"http://{HOST}:{page.server.get_port()}"
        say.show(f"Open {url} in a browser; Ctrl-C ends it.")
        if say.as_json:
            print(json.dumps({**record, "url": url}, allow_nan=False), flush=True)
        while True:
            time.sleep(3600)
    return 0


@contextmanager
def page_of(shown: Shown, config: PlannerConfig, *, port: int = FIRST_PORT) -> Iterator[Page]:
    """A page that is served while the context lasts, at the port or the next that is free."""
    check_library()
    import viser

    from graspmatch.apps.viewer.page import Page

    with redirect_stdout(StringIO()):  # it says hello and good-bye where results go
        server = viser.ViserServer(host=HOST, port=port, label="graspmatch", verbose=False)
    try:
        # No button that would share the page through a server elsewhere.
        server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(59, 110, 165))
        catalogue, scene = catalogue_of(shown, config)
        yield Page(server, shown, catalogue, shown.hand.gripper.name, scene)
    finally:
        with redirect_stdout(StringIO()):
            server.stop()


def catalogue_of(shown: Shown, config: PlannerConfig) -> tuple[Catalogue, str]:
    """All built-in hands and objects made by code, with those that are shown; and the name of the scene shown."""
    from graspmatch.apps.viewer.shown import Catalogue
    from graspmatch.scene.household import OBJECTS

    quiet = Speech(quiet=True)
    hands: dict[str, Callable[[], Hand]] = {
        name: lambda name=name: load_hand(name, None, config, quiet) for name in known_grippers()
    }
    scenes: dict[str, Callable[[], Scene]] = {
        name: lambda name=name, make=make: replace(Scene.from_mesh(make().mesh), source=name)
        for name, make in sorted(OBJECTS.items())
    }
    hands = {shown.hand.gripper.name: lambda: shown.hand} | hands
    hands[shown.hand.gripper.name] = lambda: shown.hand
    first = next(iter(scenes))
    if shown.scene is not None:
        scene, first = shown.scene, Path(shown.scene.source).stem
        scenes = {first: lambda: scene} | {name: made for name, made in scenes.items() if name != first}
    cached = {name: lru_cache(maxsize=1)(made) for name, made in scenes.items()}
    return Catalogue(hands, cached, config), first


def check_library() -> None:
    """Refuse where viser is not installed."""
    from importlib.util import find_spec

    if find_spec("viser") is None:
        raise GraspmatchError("The viewer needs viser, which is not installed: pip install 'graspmatch[view]'.")
