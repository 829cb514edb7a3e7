"""The built-in hands: one folder each, with a card and the description that it belongs to."""

from __future__ import annotations

from pathlib import Path

from graspmatch.errors import GraspmatchError

ZOO = Path(__file__).parent


def known_grippers() -> tuple[str, ...]:
    """Names of the built-in hands."""
    return tuple(sorted(card.parent.name for card in ZOO.glob("*/card.toml")))


def card_path(name: str | Path) -> Path:
    """The card of a built-in hand, or the given path if it is one."""
    if str(name) in known_grippers():
        return ZOO / str(name) / "card.toml"
    if Path(name).suffix == ".toml":
        return Path(name)
    raise GraspmatchError(
        f"No gripper named '{name}'. Known: {', '.join(known_grippers())}; or give the path of a card (.toml)."
    )
