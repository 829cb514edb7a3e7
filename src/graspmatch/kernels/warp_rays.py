"""What rays find, for the kernels that draw: the camera, the surfaces that it sees, the light that reaches them.

64 patterns of ray directions repeat over tiles of 8 x 8 samples, and shading averages the light over such a tile, on
the same surface. So the average holds every pattern once, few rays a sample are enough, and there is no noise to see.
All positions are in the world frame, lengths in metres, colours linear.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

BACKGROUND = wp.constant(-1)
FLOOR = wp.constant(-2)
SKY_RAYS = wp.constant(2)
TILE = wp.constant(8)
FAR = wp.constant(1.0e6)
GOLDEN = wp.constant(0.61803398875)


@wp.struct
class View:
    """A pinhole camera; the ray through pixel coordinates (x, y) is corner + x * right + y * down."""

    origin: wp.vec3
    corner: wp.vec3
    right: wp.vec3
    down: wp.vec3
    width: int
    height: int
    row_stride: int


@wp.struct
class Setting:
    """Light and surroundings, scaled to what is shown."""

    sun: wp.vec3  # towards the light
    sun_radius: float  # tangent of the half angle of the light: how soft shadows are
    sun_colour: wp.vec3
    sky_colour: wp.vec3
    reach: float  # how far occluders of the sky matter
    lift: float  # how far rays start from their surface
    top_colour: wp.vec3  # of the background
    bottom_colour: wp.vec3
    has_floor: int
    up: wp.vec3
    floor_offset: float
    floor_centre: wp.vec3
    floor_radius: float  # where the floor has half faded into the background
    floor_colour: wp.vec3


@wp.func
def place(element: int, columns: int, rows: int, stride: int) -> wp.vec2i:
    """Column and row of an element of a launch."""
    return wp.vec2i(element % columns, (element // columns) * stride % rows)


@wp.func
def ray_direction(view: View, sample_x: int, sample_y: int) -> wp.vec3:
    """Of one of the 2 x 2 samples of a pixel: rotated by 27 degrees, so that steep edges have four levels too."""
    quarter_x = float(sample_x % 2)
    quarter_y = float(sample_y % 2)
    x = float(sample_x // 2) + 0.375 + 0.5 * quarter_x - 0.25 * quarter_y
    y = float(sample_y // 2) + 0.125 + 0.5 * quarter_y + 0.25 * quarter_x
    return wp.normalize(view.corner + x * view.right + y * view.down)


@wp.func
def pattern_rank(sample_x: int, sample_y: int) -> int:
    """Place of a sample in its tile as a Bayer matrix orders them: near samples get patterns far apart."""
    rank = int(0)
    for bit in range(3):
        x = (sample_x >> bit) & 1
        y = (sample_y >> bit) & 1
        rank = rank * 4 + (x ^ y) * 2 + y
    return rank


@wp.func
def perpendicular(n: wp.vec3) -> wp.vec3:
    if wp.abs(n[2]) < 0.7:
        return wp.normalize(wp.cross(n, wp.vec3(0.0, 0.0, 1.0)))
    return wp.normalize(wp.cross(n, wp.vec3(1.0, 0.0, 0.0)))


@wp.func
def towards_tangent_plane(p: wp.vec3, corner: wp.vec3, normal: wp.vec3) -> wp.vec3:
    return p - wp.min(wp.dot(p - corner, normal), 0.0) * normal


@wp.func
def fraction(x: float) -> float:
    return x - wp.floor(x)


@wp.func
def smoothstep(low: float, high: float, x: float) -> float:
    t = wp.clamp((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def floor_distance(d: wp.vec3, view: View, setting: Setting) -> float:
    """Where a ray of the camera meets the floor, `FAR` where it does not."""
    facing = wp.dot(d, setting.up)
    if setting.has_floor == 1 and facing < -1.0e-6:
        s = (setting.floor_offset - wp.dot(view.origin, setting.up)) / facing
        if s > 0.0:
            return wp.min(s, FAR)
    return FAR


@wp.struct
class Seen:
    """What a ray meets: a body, where (a little above the surface), and the shading normal."""

    body: int
    position: wp.vec3
    normal: wp.vec3


@wp.func
def seen_along(
    d: wp.vec3,
    farthest: float,
    mesh: wp.uint64,
    face_body: wp.array(dtype=int),
    corner_normals: wp.array2d(dtype=wp.vec3),
    view: View,
    setting: Setting,
) -> Seen:
    """The nearest body along a ray of the camera, or none."""
    seen = Seen()
    seen.body = BACKGROUND
    hit = wp.mesh_query_ray(mesh, view.origin, d, farthest)
    if hit.result:
        seen.body = face_body[hit.face]
        w = 1.0 - hit.u - hit.v
        n0 = corner_normals[hit.face, 0]
        n1 = corner_normals[hit.face, 1]
        n2 = corner_normals[hit.face, 2]
        normal = wp.normalize(hit.u * n0 + hit.v * n1 + w * n2)
        # Start light rays from the smooth surface that the normals pretend, so that flat facets cast no shadow on
        # themselves where the light grazes (Hanika 2021).
        p = view.origin + hit.t * d
        g = hit.normal
        position = p
        if wp.dot(g, d) > 0.0:  # the back of an open scan
            g = -g
            normal = -normal
        else:
            p0 = towards_tangent_plane(p, wp.mesh_get_point(mesh, 3 * hit.face), n0)
            p1 = towards_tangent_plane(p, wp.mesh_get_point(mesh, 3 * hit.face + 1), n1)
            p2 = towards_tangent_plane(p, wp.mesh_get_point(mesh, 3 * hit.face + 2), n2)
            position = hit.u * p0 + hit.v * p1 + w * p2
        seen.position = position + setting.lift * g
        seen.normal = normal
    return seen


@wp.func
def light_at(mesh: wp.uint64, p: wp.vec3, n: wp.vec3, rank: int, setting: Setting) -> wp.vec2:
    """What the few rays of one of the patterns find: visible share of the sun, and brightness of the sky."""
    sun = float(0.0)
    if wp.dot(n, setting.sun) > 0.0:
        radius = setting.sun_radius * wp.sqrt((float(rank) + 0.5) / float(TILE * TILE))
        angle = 2.0 * wp.pi * fraction(float(rank) * GOLDEN)
        a = perpendicular(setting.sun)
        b = wp.cross(setting.sun, a)
        d = wp.normalize(setting.sun + radius * (wp.cos(angle) * a + wp.sin(angle) * b))
        if not wp.mesh_query_ray_anyhit(mesh, p, d, FAR):
            sun = 1.0

    sky = float(0.0)
    a = perpendicular(n)
    b = wp.cross(n, a)
    for k in range(SKY_RAYS):
        index = float(rank * SKY_RAYS + k)
        u = (index + 0.5) / float(TILE * TILE * SKY_RAYS)
        angle = 2.0 * wp.pi * fraction(index * GOLDEN)
        r = wp.sqrt(u)
        d = r * wp.cos(angle) * a + r * wp.sin(angle) * b + wp.sqrt(1.0 - u) * n
        if not wp.mesh_query_ray_anyhit(mesh, p, d, setting.reach):
            height = wp.dot(d, setting.up)
            brightness = 0.8 + 0.2 * height
            if height < 0.0 and setting.has_floor == 1:
                # Light that the floor sends back; near contact the floor itself lies in the shade.
                s = (setting.floor_offset - wp.dot(p, setting.up)) / height
                brightness = 0.6 * smoothstep(0.0, 0.5 * setting.reach, wp.max(s, 0.0)) + 0.08
            elif height < 0.0:
                brightness = 0.8 + 0.5 * height
            sky += brightness
    return wp.vec2(sun, sky / float(SKY_RAYS))
