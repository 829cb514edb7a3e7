"""The paper's experiments in simulation: Tables II and III, printed in the paper's simulator, a laptop's RTX 2070."""

from __future__ import annotations

PAPER = {
    "franka_hand": {
        "Cat": (0.98, 2.42),
        "Detergent": (0.96, 2.57),
        "Bottle": (0.96, 1.92),
        "LetterP": (0.96, 2.63),
        "Shampoo": (0.94, 2.54),
        "Spray": (0.92, 2.45),
        "Glass": (0.96, 2.70),
        "Mug": (0.96, 2.32),
        "Shark": (0.02, 2.17),
        "Shoe": (0.54, 2.51),
        "mean": (0.820, 2.42),
    },
    "barrett_bh282": {
        "Cat": (1.00, 0.996),
        "Detergent": (1.00, 1.28),
        "Dwarf": (1.00, 1.56),
        "LetterP": (1.00, 1.55),
        "Milk": (1.00, 1.43),
        "Shampoo": (0.92, 1.20),
        "Spray": (0.86, 1.40),
        "Glass": (0.96, 1.24),
        "Unicorn": (0.98, 1.43),
        "Mug": (0.96, 0.972),
        "Shark": (0.14, 1.12),
        "mean": (0.893, 1.29),
    },
}
"""Success rate and seconds per plan, by gripper and object."""

TABLES = {"franka_hand": "Table II", "barrett_bh282": "Table III"}
