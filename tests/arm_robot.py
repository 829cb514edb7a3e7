"""A robot arm of seven hinges with the proportions of a lightweight arm, as URDF; its meshes do not exist."""

from __future__ import annotations

from pathlib import Path

JOINTS = (  # xyz, rpy, lower, upper
    ("0 0 0.333", "0 0 0", -2.9, 2.9),
    ("0 0 0", "-1.5707963 0 0", -1.76, 1.76),
    ("0 -0.316 0", "1.5707963 0 0", -2.9, 2.9),
    ("0.0825 0 0", "1.5707963 0 0", -3.07, -0.07),
    ("-0.0825 0.384 0", "-1.5707963 0 0", -2.9, 2.9),
    ("0 0 0", "1.5707963 0 0", -0.02, 3.75),
    ("0.088 0 0", "1.5707963 0 0", -2.9, 2.9),
)


def write_arm(folder: Path) -> Path:
    """The file; its last link is `flange`."""
    visual = '<visual><geometry><mesh filename="package://nowhere/link.stl"/></geometry></visual>'
    links = [f'<link name="link{i}">{visual}</link>' for i in range(len(JOINTS) + 1)] + ['<link name="flange"/>']
    joints = [
        f'<joint name="joint{i + 1}" type="revolute"><parent link="link{i}"/><child link="link{i + 1}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/></joint>'
        for i, (xyz, rpy, lower, upper) in enumerate(JOINTS)
    ]
    joints.append(
        '<joint name="mount" type="fixed"><parent link="link7"/><child link="flange"/>'
        '<origin xyz="0 0 0.107" rpy="0 0 -0.785398"/></joint>'
    )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(links + joints)}</robot>')
    return path
