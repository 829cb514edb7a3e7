"""Plan with a recording and show everything on a page in the browser. Needs `pip install "graspmatch[view]"`.

python examples/view.py [--seconds 60]
"""

import argparse
import time

from graspmatch.apps.hand import load_hand
from graspmatch.apps.speech import Speech
from graspmatch.apps.viewer.command import page_of
from graspmatch.apps.viewer.shown import shown_of
from graspmatch.config import PlannerConfig
from graspmatch.planner.plan import plan
from graspmatch.planner.recording import Recording
from graspmatch.scene.household import OBJECTS
from graspmatch.scene.scene import Scene

parser = argparse.ArgumentParser()
parser.add_argument("--seconds", type=float, default=3600, help="how long the page is served")
parser.add_argument("--port", type=int, default=8080)
arguments = parser.parse_args()

config = PlannerConfig()
hand = load_hand("barrett_bh282", None, config, Speech())
scene = Scene.from_mesh(OBJECTS["bottle"]().mesh)
recording = Recording()
grasps = plan(scene, hand.gripper, config, recording=recording)

with page_of(shown_of(hand, grasps, scene, recording, config.device), config, port=arguments.port) as page:
    print(f"Open http://127.0.0.1:{page.server.get_port()} in a browser")
    page.panel.also.value = min(3, len(grasps))  # the page can be changed from here, too
    time.sleep(arguments.seconds)
