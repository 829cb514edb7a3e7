"""The README's table of hands, from their cards: printed, or with `--write` put into the README."""

from __future__ import annotations

import sys
from pathlib import Path

from graspmatch.gripper.card import postures, read_card
from graspmatch.gripper.zoo import card_path, known_grippers

README = Path(__file__).parents[1] / "README.md"
BEGIN, END = "<!-- hands: bench/hands.py -->\n\n", "\n<!-- end of hands -->"


def table_of_hands() -> str:
    """One row for each built-in hand, by name."""
    lines = [
        "| name | hand | fingers | driven joints | preshapes | opening | shape |",
        "| --- | --- | ---: | ---: | ---: | ---: | --- |",
    ]
    for name in known_grippers():
        card = read_card(card_path(name))
        counts = f"{len(card.fingers)} | {len(card.joints)} | {len(postures(card, card.joint_names))}"
        shape = f"from {card.source}" if card.source else "in the package"
        lines.append(f"| `{name}` | {card.title} | {counts} | {1000 * card.opening:.0f} mm | {shape} |")
    return "\n".join(lines) + "\n"


def readme_with_table(text: str) -> str:
    """The README's text with the table as it is now."""
    before, rest = text.split(BEGIN)
    return before + BEGIN + table_of_hands() + END + rest.split(END)[1]


if __name__ == "__main__":
    if "--write" in sys.argv:
        README.write_text(readme_with_table(README.read_text()))
    else:
        print(table_of_hands(), end="")
