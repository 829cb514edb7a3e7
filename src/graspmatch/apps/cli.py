"""The command line: options become a call of the library, errors become one line and an exit status."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from graspmatch.config import PlannerConfig
from graspmatch.errors import GraspmatchError

DESCRIPTION = """Plan 6-DoF grasps for any hand from a mesh or a point cloud.

Exit status: 0 done, 1 a fault of graspmatch, 2 something given cannot be used, 3 no grasp was found."""

SHORT_FORMS = {"--method": "--matching.method", "--count": "--ranking.count"}
"""Options of the configuration that are used often enough to have a second name."""

Config = Annotated[PlannerConfig, tyro.conf.arg(name="")]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Plan grasps for an object; --method and --count are short for --matching.method and --ranking.count."""

    input: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="INPUT")]
    """Mesh or point cloud: STL, OBJ, PLY, GLB, PCD, XYZ, NPZ or NPY."""
    gripper: str
    """Name of a known hand, or path of a card (TOML)."""
    description: Path | None = None
    """URDF or MJCF file to use instead of the one that the card names."""
    output: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(aliases=["-o"])] = ()
    """File to write: .npz, or .yaml for Isaac; may be given more than once."""
    picture: Path | None = None
    """Picture of the object and the best grasps to write (.png)."""
    table: Annotated[str, tyro.conf.arg(metavar="auto|none|z=HEIGHT")] = "auto"
    """Plane that the object stands on: under its lowest point, none, or at a height in the unit of the input."""
    unit: Literal["auto", "m", "mm", "cm"] = "auto"
    """Unit of length of the input."""
    obstacles: Path | None = None
    """Point cloud that the hand must not touch, in the frame and unit of the input."""
    starts: Path | None = None
    """Grasps to start from in place of the configured seeds, from this or another planner (.npz or Isaac .yaml)."""
    json: bool = False
    """Print one JSON object on stdout and everything else on stderr."""
    quiet: bool = False
    """Print nothing but errors."""
    debug: bool = False
    """Print the traceback of an error."""
    config: Config = field(default_factory=PlannerConfig)


@dataclass(frozen=True, kw_only=True)
class Grippers:
    """List the hands that are built in."""

    json: bool = False
    """Print one JSON object on stdout."""
    debug: bool = False
    """Print the traceback of an error."""


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


Command = (
    Annotated[Plan, tyro.conf.subcommand("plan")]
    | Annotated[Grippers, tyro.conf.subcommand("grippers")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the result is the exit status. Options that cannot be parsed leave by SystemExit(2)."""
    command = parse(sys.argv[1:] if argv is None else argv)
    try:
        return run(command)
    except GraspmatchError as error:
        return _failed(command, " ".join(str(error).split()), status=2)
    except KeyboardInterrupt:
        return _failed(command, "interrupted", status=130)
    except Exception as error:
        message = " ".join(f"{type(error).__name__}: {error}".split())
        return _failed(command, f"unexpected {message} (--debug shows where)", status=1)


def parse(argv: Sequence[str]) -> Plan | Grippers | Demo:
    """The command of a command line."""
    words = [_long_form(word) for word in argv]
    options = (tyro.conf.FlagCreatePairsOff, tyro.conf.OmitSubcommandPrefixes, tyro.conf.DisallowNone)
    return tyro.cli(Command, prog="graspmatch", description=DESCRIPTION, args=words, config=options)


def run(command: Plan | Grippers | Demo) -> int:
    """Do what a command says; the result is the exit status."""
    # Loaded now, not above: asking for help should not wait for them.
    from graspmatch.apps import commands

    if isinstance(command, Grippers):
        return commands.list_grippers(as_json=command.json)
    say = commands.Speech(as_json=command.json, quiet=command.quiet)
    if isinstance(command, Demo):
        return commands.demo(command.folder, command.config, say)
    return commands.plan_file(
        command.input,
        command.gripper,
        command.config,
        say,
        description=command.description,
        outputs=commands.Outputs(command.output, command.picture),
        table=parse_table(command.table),
        unit=command.unit,
        obstacles=command.obstacles,
        starts=command.starts,
    )


def parse_table(text: str) -> float | Literal["auto"] | None:
    """`auto`, `none`, or a height [m] as `z=0.02` or `0.02`."""
    if text == "auto":
        return "auto"
    if text == "none":
        return None
    try:
        height = float(text.removeprefix("z="))
    except ValueError:
        raise GraspmatchError(
            f"No table '{text}'. Possible: auto, none, or a height in the unit of the input, as z=0.02."
        ) from None
    if not abs(height) < float("inf"):
        raise GraspmatchError(f"The table's height is '{text}'; it must be a finite number.")
    return height


def _long_form(word: str) -> str:
    """An option by its full name."""
    name, equals, value = word.partition("=")
    return SHORT_FORMS.get(name, name) + equals + value


def _failed(command: Plan | Grippers | Demo, message: str, *, status: int) -> int:
    """Say in one line what went wrong."""
    if command.debug:
        traceback.print_exc()
    print(f"error: {message}", file=sys.stderr)
    if command.json:
        print(json.dumps({"error": message}))
    return status


if __name__ == "__main__":
    sys.exit(main())
