"""The commands and their options: the command line is made of these."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from graspmatch.config import PlannerConfig, ViewConfig

Experiment = Literal["paper", "ablation", "quick", "view", "clutter"]
Config = Annotated[PlannerConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Capture:
    """A capture of a whole scene, and which object in it is the target."""

    depth: Path | None = None
    """Depth image of a scene, in place of INPUT: 16 bit PNG or TIFF, EXR, NPY or NPZ."""
    intrinsics: str | None = None
    """Of the depth camera: camera_info YAML or JSON, a file of the 3x3 matrix, or fx,fy,cx,cy."""
    camera_pose: str | None = None
    """T_world_camera: a file of the 4x4 matrix or of a ROS pose, or x,y,z,qw,qx,qy,qz; none: camera frame."""
    up: str | None = None
    """Direction against gravity in the camera frame as x,y,z, where the camera's pose is not known."""
    depth_scale: float | None = None
    """Metres for one step of the depth; none: integers are millimetres, floats metres."""
    correct_depth: Literal["auto", "depth", "tilt", "off"] = "auto"
    """auto: make the table come out at the given --table by turning the camera and scaling and tilting the depth;
    depth: by the depth alone, the pose is exact; tilt: only make it level."""
    complete: bool = True
    """Guess the far side of the target, which the camera did not see."""
    object: int | None = None
    """Number of the target in the scene; 0 is the one of which most is seen."""
    at: str | None = None
    """Place of the target as x,y: column and row in an image, metres in a cloud without rows."""
    mask: Path | None = None
    """Image that marks the target's pixels, or several objects by their values."""
    topic: str | None = None
    """Topic of a bag to read; none: the only depth image, or the only cloud."""


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """Where hands start, in place of the configured pattern."""

    seeds: Path | None = None
    """Grasps of this or another planner in any format, or a mixture of Gaussians (TOML); matching refines them."""
    seeds_gripper: str | None = None
    """Hand that they are of; none: that which the file names, or else --gripper."""
    seeds_frame: Literal["base", "canonical"] = "base"
    """What poses in YAML and TOML are of: the base link, or canonical (+z approach, +x closing) as GraspGen's."""
    seeds_pose: str | None = None
    """Pose in the world of the frame that they are in: a file, or x,y,z,qw,qx,qy,qz; none: they are in the world."""


@dataclass(frozen=True, kw_only=True)
class Robot:
    """The arm that has to get there."""

    robot: Path | None = None
    """URDF or MJCF file of the robot: grasps that its arm cannot reach and leave straight are dropped."""
    robot_tip: str | None = None
    """Link that the hand is mounted on; none: the hand's own base link, where the robot has it."""
    robot_base: str | None = None
    """T_world_base of the robot: a file, or x,y,z,qw,qx,qy,qz; none: the world is the robot's."""
    robot_mount: str | None = None
    """T_tip_gripper, how the hand is mounted: a file, or x,y,z,qw,qx,qy,qz; none: its base link is the tip."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Plan grasps for an object; --method and --count are short for --matching.method and --ranking.count."""

    input: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="INPUT")] = None
    """Mesh or point cloud: STL, OBJ, PLY, GLB, PCD, XYZ, NPZ or NPY; or a ROS bag or MCAP file."""
    gripper: str
    """Name of a known hand, or path of a card (TOML)."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    output: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(aliases=["-o"])] = ()
    """File to write: .npz, .yaml for Isaac, or another format (docs/formats.md); may be given more than once."""
    picture: Path | None = None
    """Picture of the object and the best grasps to write (.png)."""
    table: Annotated[str, tyro.conf.arg(metavar="auto|none|z=HEIGHT")] = "auto"
    """Plane that the object stands on: under its lowest point, none, or at a height in the unit of the input."""
    unit: Literal["auto", "m", "mm", "cm"] = "auto"
    """Unit of length of the input."""
    obstacles: Path | None = None
    """Point cloud that the hand must not touch, in the frame and unit of the input."""
    capture: Annotated[Capture, tyro.conf.arg(name="")] = field(default_factory=Capture)
    all: bool = False
    """Plan for every object of a capture, and say in which order to pick them."""
    seeds: Annotated[Seeds, tyro.conf.arg(name="")] = field(default_factory=Seeds)
    robot: Annotated[Robot, tyro.conf.arg(name="")] = field(default_factory=Robot)
    approach_distance: float | None = None
    """Length of the straight way in [m]; none: 0.15. The first time, the hand's fields are computed for it."""
    fast: bool = False
    """In a fraction of the time: hands start once, and the best grasps are not refined."""
    view: bool = False
    """Then show the grasps, and how they were found, on a page in the browser."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""
    config: Config = field(default_factory=PlannerConfig)


@dataclass(frozen=True, kw_only=True)
class ListGrippers:
    """List the hands that are built in."""

    json: bool = False
    """Print one JSON object on stdout."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class AddGripper:
    """Write the card of a hand from its description, and a picture of what was found."""

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """URDF or MJCF file of the hand; a xacro must be expanded first."""
    name: str | None = None
    """What the hand is called; none: as its file."""
    root: str | None = None
    """Link at which the hand begins, where the file has several hands, or an arm; none: it is found."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path(".")
    """Folder for NAME.toml and NAME.png."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Grippers:
    """List the hands that are built in, or add one of your own."""

    what: Annotated[
        Annotated[ListGrippers, tyro.conf.subcommand("list")] | Annotated[AddGripper, tyro.conf.subcommand("add")],
        tyro.conf.arg(name=""),
    ] = field(default_factory=ListGrippers)

    @property
    def json(self) -> bool:
        """As the inner command says."""
        return self.what.json

    @property
    def debug(self) -> bool:
        """As the inner command says."""
        return self.what.debug


@dataclass(frozen=True, kw_only=True)
class Demo:
    """Plan grasps for a mug with the Franka Hand: a table, grasps.yaml, grasps.npz and grasps.png."""

    folder: Path = Path("demo")
    """Where the files go; made if it is missing."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""
    config: Config = field(default_factory=PlannerConfig)


@dataclass(frozen=True, kw_only=True)
class Simulate:
    """Try grasps of a file in the simulator, and say which hold."""

    grasps: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRASPS")]
    """File of grasps: .npz, Isaac .yaml, GraspNet .npy, or another format (docs/formats.md)."""
    object: Path
    """Mesh of the object, in the frame of the grasps."""
    gripper: str | None = None
    """Name of a known hand, or path of a card; none: the hand that the file names."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    protocol: Literal["lift", "fc6", "tug"] = "lift"
    """lift: pick it up from the table; fc6: six pushes without gravity; tug: five pulls without gravity."""
    friction: float | None = None
    """Sliding friction; none: the protocol's."""
    mass: float | None = None
    """Mass of the object [kg]; none: the protocol's."""
    first: int | None = None
    """Try only the best so many."""
    table: Annotated[str, tyro.conf.arg(metavar="auto|z=HEIGHT")] = "auto"
    """Plane that the object stands on: under its lowest point, or at a height."""
    unit: Literal["auto", "m", "mm", "cm"] = "auto"
    """Unit of length of the mesh."""
    video: Path | None = None
    """Video of the first grasp to write (.mp4 or .gif)."""
    strip: Path | None = None
    """Picture of the first grasp at eight moments to write (.png)."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Plan for objects at random places and lift the best grasp of each plan in the simulator."""

    what: Annotated[tyro.conf.Positional[Experiment], tyro.conf.arg(metavar="WHAT")]
    """paper: Table II or III; ablation: numbers of initialisations, and methods; quick: twelve objects made by code;
    view: planned from one depth image each; clutter: piles of objects, cleared from one depth image after another."""
    gripper: str = "franka_hand"
    """Name of a known hand, or path of a card."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    objects: Path = Path("../shared/data/objects/paper")
    """Folder of NAME/mesh.stl, or of mesh files; not for quick."""
    trials: int | None = None
    """Per object, or piles; none: 50 for paper, 5 for ablation, 3 for quick, 10 for view, 20 for clutter."""
    friction: float = 0.6
    """Sliding friction of every contact."""
    mass: float | None = None
    """Of every object [kg]; none: from its volume."""
    pose_error_mm: float = 0.0
    """Standard deviation of the hand's position along each axis."""
    pose_error_deg: float = 0.0
    """Of its rotation about each axis."""
    camera: Annotated[ViewConfig, tyro.conf.arg(name="camera")] = field(default_factory=ViewConfig)
    fast: bool = False
    """As of `graspmatch plan`: hands start once, and the best grasps are not refined."""
    pile: int = 5
    """Objects in a pile."""
    processes: int | None = None
    """How many trials run at once; none: one for each core."""
    output: Path = Path("bench-results")
    """Folder for results; trials that are in it already are not run again."""
    fresh: bool = False
    """Run all trials again."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""
    config: Config = field(default_factory=PlannerConfig)


@dataclass(frozen=True, kw_only=True)
class Convert:
    """Write the grasps of a file in another format; the suffixes say which."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """.npz, .yaml of Isaac, .npy of GraspNet, .h5 of ACRONYM, .json of GraspGen, or .yaml of moveit_msgs/Grasp."""
    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUTPUT")]
    """The same; .moveit.yaml for moveit_msgs/Grasp."""
    gripper: str | None = None
    """Name of a known hand, or path of a card; none: the hand that the file names, if it names one."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    frame: Literal["base", "canonical"] = "base"
    """What poses in YAML of other tools are of: the base link, or canonical (+z approach, +x closing) as GraspGen's."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Show grasps on a page in the browser: how the hand moves and what it touches; and plan others there."""

    grasps: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRASPS")]
    """File of grasps: .npz, Isaac .yaml, GraspNet .npy, or another format (docs/formats.md)."""
    object: Path | None = None
    """Mesh or cloud of the object, in the frame of the grasps."""
    gripper: str | None = None
    """Name of a known hand, or path of a card; none: the hand that the file names."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    table: Annotated[str, tyro.conf.arg(metavar="auto|none|z=HEIGHT")] = "auto"
    """Plane that the object stands on: under its lowest point, none, or at a height in the unit of the object."""
    unit: Literal["auto", "m", "mm", "cm"] = "auto"
    """Unit of length of the object."""
    port: int = 8080
    """Where the page is served, on this machine only; if it is taken, the next that is free."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""
    config: Config = field(default_factory=PlannerConfig)


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write one HTML page about the grasps of a file: pictures, table, timing, what became of the candidates."""

    grasps: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="GRASPS")]
    """File of grasps: .npz, Isaac .yaml, GraspNet .npy, or another format (docs/formats.md)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Page to write (.html); it holds everything and opens without a network."""
    object: Path | None = None
    """Mesh or cloud of the object, in the frame of the grasps; without it there is no picture."""
    verdicts: Path | None = None
    """What `graspmatch simulate --json` printed about these grasps."""
    gripper: str | None = None
    """Name of a known hand, or path of a card; none: the hand that the file names."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    table: Annotated[str, tyro.conf.arg(metavar="auto|none|z=HEIGHT")] = "auto"
    """Plane that the object stands on: under its lowest point, none, or at a height in the unit of the object."""
    unit: Literal["auto", "m", "mm", "cm"] = "auto"
    """Unit of length of the object."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""


Command = (
    Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Grippers, tyro.conf.subcommand("grippers")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Report, tyro.conf.subcommand("report")]
)
Parsed = Plan | Grippers | Demo | Simulate | Bench | Convert | View | Report
