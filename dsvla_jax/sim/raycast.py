# pyright: reportAttributeAccessIssue=false
# (mujoco's extension modules export names that pyright cannot see)
"""A ray caster for MuJoCo's primitive geoms, in pure JAX: colour, planar depth and segmentation in one pass.

It replaces an OpenGL renderer where the picture must be made inside a jitted program, or where no GL exists. Every
primitive but the plane is convex, so a ray meets it in one interval [enter, leave]; the camera sees the least ``enter``
and a point is in shadow when the ray towards the light has an interval that ends in front of it. Rays of pixels are
scaled to Z = 1 in the camera frame, so the ray parameter *is* the planar depth.

Geoms of one type share a ``lax.scan`` that keeps the nearest hit of every ray: the working set of a block of rows stays
in the cache, and neither memory nor compile time grows with the number of geoms.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from dsvla_jax.sim.light import light_direction
from dsvla_jax.types import Array, Camera

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)

FIRST_HIDDEN_GROUP = 3  # mujoco's viewers show geom groups 0 to 2 and hide 3 to 5
NEAR = 0.01
FAR = 4.5  # clipping planes of RLBench's cameras, metres
SKY = (0.62, 0.72, 0.82)
AMBIENT, HEADLIGHT, SUN = 0.35, 0.25, 0.5
MAX_BLOCK_RAYS = 2**15  # more rays at once fall out of a CPU's second-level cache
_TINY = 1e-9
_SHADOW_OFFSET = 1e-3


class Vector(NamedTuple):
    """Components kept apart: each is one contiguous row over the rays, which is what vectorises."""

    x: Array
    y: Array
    z: Array


Span = tuple[Array, Array]  # ray parameters at which rays enter and leave a geom; enter > leave where they miss
Interval = Callable[[Vector, Vector, Array], Span]  # origins, directions in the geom's frame, its size
Carry = TypeVar("Carry")


class Geom(NamedTuple):
    """One geom: position (3,) and rotation (3, 3) in the world, size (3,), geom id (), and whether it is drawn ()."""

    position: Array
    rotation: Array
    size: Array
    number: Array
    shown: Array


class Poses(NamedTuple):
    """xpos: float32 (Ng, 3), xmat: float32 (Ng, 3, 3), world poses of all geoms. rgba: float32 (Ng, 4)."""

    xpos: Array
    xmat: Array
    rgba: Array


@struct.dataclass
class Primitives:
    """The visible geoms of a model, grouped by type.

    sizes: float32 (Ng, 3), MuJoCo's ``geom_size`` of all geoms (half extents, radii, half lengths).
    groups: ((geom type, (geom ids...)), ...), static, only of visible geoms.
    light_direction: float32 (3,), unit, the direction in which light travels, world frame.
    """

    sizes: Array
    light_direction: Array
    groups: tuple[tuple[int, tuple[int, ...]], ...] = struct.field(pytree_node=False)
    geom_types: tuple[int, ...] = struct.field(pytree_node=False)


def primitives_from_model(model: mujoco.MjModel) -> Primitives:
    """The geoms of ``model`` a camera sees: alpha above zero and group below 3.

    Raises ValueError when a visible geom is a mesh, a height field or an SDF.
    """
    groups = {kind: [] for kind in _INTERVALS}
    for index in range(model.ngeom):
        kind = int(model.geom_type[index])
        if model.geom_group[index] >= FIRST_HIDDEN_GROUP or model.geom_rgba[index, 3] == 0:
            continue
        if kind not in groups:
            name = model.geom(index).name or f"#{index}"
            raise ValueError(
                f"geom {name!r} has type {mujoco.mjtGeom(kind).name}, which the ray caster cannot draw; use a plane, "
                "sphere, capsule, ellipsoid, cylinder or box, or hide it (group 3 or alpha 0)"
            )
        groups[kind].append(index)
    return Primitives(
        sizes=jnp.asarray(model.geom_size, jnp.float32),
        light_direction=jnp.asarray(light_direction()),
        groups=tuple((kind, tuple(members)) for kind, members in groups.items() if members),
        geom_types=tuple(int(kind) for kind in model.geom_type),
    )


def _dot(a: Vector, b: Vector) -> Array:
    return a.x * b.x + a.y * b.y + a.z * b.z


def _into(rotation: Array, v: Vector) -> Vector:
    """World to local: the transpose of ``rotation`` (..., 3, 3), whose columns are the local axes in the world."""
    return Vector(
        *(rotation[..., 0, i] * v.x + rotation[..., 1, i] * v.y + rotation[..., 2, i] * v.z for i in range(3))
    )


def _out_of(rotation: Array, v: Vector) -> Vector:
    return Vector(
        *(rotation[..., i, 0] * v.x + rotation[..., i, 1] * v.y + rotation[..., i, 2] * v.z for i in range(3))
    )


def _slab(origin: Array, direction: Array, half: Array) -> Span:
    """Interval in which |origin + t direction| <= half."""
    inverse = 1.0 / jnp.where(jnp.abs(direction) < _TINY, _TINY, direction)
    middle, reach = -origin * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _ball(origins: Sequence[Array], directions: Sequence[Array], radius: Array) -> Span:
    """Interval inside a ball or (two components) an infinite cylinder.

    The squared distance of the closest approach is formed from the perpendicular itself instead of by b^2 - 4ac: that
    keeps single precision good to a fraction of a millimetre for centimetre radii seen from metres away.
    """
    square = sum(d * d for d in directions)
    inverse = 1.0 / jnp.maximum(square, _TINY * _TINY)
    closest = -sum(o * d for o, d in zip(origins, directions, strict=True)) * inverse
    miss = sum((o + closest * d) ** 2 for o, d in zip(origins, directions, strict=True))
    inside = radius * radius - miss
    reach = jnp.sqrt(jnp.maximum(inside, 0.0) * inverse)
    hit = inside >= 0.0
    return jnp.where(hit, closest - reach, jnp.inf), jnp.where(hit, closest + reach, -jnp.inf)


def _sphere(o: Vector, d: Vector, size: Array) -> Span:
    return _ball(o, d, size[0])


def _ellipsoid(o: Vector, d: Vector, size: Array) -> Span:
    inverse = 1.0 / size
    return _ball([c * inverse[i] for i, c in enumerate(o)], [c * inverse[i] for i, c in enumerate(d)], jnp.float32(1.0))


def _cylinder(o: Vector, d: Vector, size: Array) -> Span:
    around, between = _ball(o[:2], d[:2], size[0]), _slab(o.z, d.z, size[1])
    return jnp.maximum(around[0], between[0]), jnp.minimum(around[1], between[1])


def _capsule(o: Vector, d: Vector, size: Array) -> Span:
    body = _cylinder(o, d, size)
    missed = body[0] > body[1]
    enter, leave = jnp.where(missed, jnp.inf, body[0]), jnp.where(missed, -jnp.inf, body[1])
    for end in (size[1], -size[1]):
        cap = _ball((o.x, o.y, o.z - end), d, size[0])
        enter, leave = jnp.minimum(enter, cap[0]), jnp.maximum(leave, cap[1])
    return enter, leave


def _box(o: Vector, d: Vector, size: Array) -> Span:
    slabs = [_slab(o[i], d[i], size[i]) for i in range(3)]
    enter = jnp.maximum(jnp.maximum(slabs[0][0], slabs[1][0]), slabs[2][0])
    leave = jnp.minimum(jnp.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])
    return enter, leave


def _plane(o: Vector, d: Vector, size: Array) -> Span:
    """A plane is seen from above only and, as in MuJoCo, is infinite along an axis whose half size is 0."""
    t = -o.z / jnp.minimum(d.z, -_TINY)
    hit = d.z < -_TINY
    for axis in range(2):
        hit &= (size[axis] <= 0.0) | (jnp.abs(o[axis] + t * d[axis]) <= size[axis])
    return jnp.where(hit, t, jnp.inf), jnp.where(hit, t, -jnp.inf)


_INTERVALS: dict[int, Interval] = {
    PLANE: _plane,
    SPHERE: _sphere,
    CAPSULE: _capsule,
    ELLIPSOID: _ellipsoid,
    CYLINDER: _cylinder,
    BOX: _box,
}


def _scan_geoms(
    primitives: Primitives,
    poses: Poses,
    carry: Carry,
    visit: Callable[[Carry, Interval, Geom], Carry],
    skip: Sequence[int] = (),
) -> Carry:
    """Folds ``visit`` over the visible geoms of all types but those to skip."""
    for kind, members in primitives.groups:
        if kind in skip:
            continue
        ids = jnp.asarray(members, jnp.int32)

        def step(state: Carry, geom: Geom, interval: Interval = _INTERVALS[kind]) -> tuple[Carry, None]:
            return visit(state, interval, geom), None

        geoms = Geom(poses.xpos[ids], poses.xmat[ids], primitives.sizes[ids], ids, poses.rgba[ids, 3] > 0.0)
        carry, _ = jax.lax.scan(step, carry, geoms)
    return carry


def _local_normal(kinds: Array, p: Vector, size: Vector) -> Vector:
    """Outward normal, not normalised, at the local surface points of geoms of mixed type; every argument over rays."""
    zero, one = jnp.zeros_like(p.x), jnp.ones_like(p.x)
    radial = jnp.sqrt(p.x * p.x + p.y * p.y)
    on_cap = size.y - jnp.abs(p.z) < size.x - radial
    gap = Vector(*(s - jnp.abs(c) for s, c in zip(size, p, strict=True)))
    face_x = (gap.x <= gap.y) & (gap.x <= gap.z)
    face_y = ~face_x & (gap.y <= gap.z)
    choices = {
        PLANE: (zero, zero, one),
        SPHERE: p,
        CAPSULE: (p.x, p.y, p.z - jnp.clip(p.z, -size.y, size.y)),
        ELLIPSOID: tuple(c / jnp.maximum(s * s, _TINY) for c, s in zip(p, size, strict=True)),
        CYLINDER: (jnp.where(on_cap, zero, p.x), jnp.where(on_cap, zero, p.y), jnp.where(on_cap, jnp.sign(p.z), zero)),
        BOX: (
            jnp.where(face_x, jnp.sign(p.x), zero),
            jnp.where(face_y, jnp.sign(p.y), zero),
            jnp.where(face_x | face_y, zero, jnp.sign(p.z)),
        ),
    }
    normal = (zero, zero, one)
    for kind, value in choices.items():
        normal = tuple(jnp.where(kinds == kind, new, old) for new, old in zip(value, normal, strict=True))
    return Vector(*normal)


def _unit(v: Vector) -> Vector:
    scale = jax.lax.rsqrt(jnp.maximum(_dot(v, v), _TINY * _TINY))
    return Vector(v.x * scale, v.y * scale, v.z * scale)


def _cast(primitives: Primitives, poses: Poses, eye: Array, d: Vector, shadows: bool) -> tuple[Array, Array, Array]:
    """Colour (R, 3) in [0, 1], ray parameter (R,) and geom id (R,) of rays ``eye + t d``."""
    xpos, xmat, rgba = poses

    def nearest(state: tuple[Array, Array], interval: Interval, geom: Geom) -> tuple[Array, Array]:
        best, winner = state
        origin = _into(geom.rotation, Vector(*(eye - geom.position)))
        enter, leave = interval(origin, _into(geom.rotation, d), geom.size)
        closer = (enter <= leave) & (enter > NEAR) & (enter < best) & geom.shown
        return jnp.where(closer, enter, best), jnp.where(closer, geom.number, winner)

    start = (jnp.full_like(d.x, jnp.inf), jnp.full(d.x.shape, -1, jnp.int32))
    t, winner = _scan_geoms(primitives, poses, start, nearest)

    hit = winner >= 0
    distance = jnp.where(hit, t, 0.0)
    geom = jnp.maximum(winner, 0)
    kinds = jnp.asarray(primitives.geom_types, jnp.int32)[geom]
    rotation, offset = xmat[geom], eye - xpos[geom]
    world_from_eye = Vector(*(distance * c for c in d))
    relative = Vector(*(offset[:, i] + c for i, c in enumerate(world_from_eye)))
    local = _into(rotation, relative)
    size = Vector(*primitives.sizes[geom].T)
    normal = _unit(_out_of(rotation, _local_normal(kinds, local, size)))

    to_light = Vector(*(-primitives.light_direction))
    view = _unit(d)
    facing = jnp.maximum(-_dot(normal, view), 0.0)
    lit = jnp.maximum(_dot(normal, to_light), 0.0)
    if shadows:
        point = Vector(*(eye[i] + world_from_eye[i] + _SHADOW_OFFSET * normal[i] for i in range(3)))

        def occluded(dark: Array, interval: Interval, geom: Geom) -> Array:
            origin = _into(geom.rotation, Vector(*(point[i] - geom.position[i] for i in range(3))))
            enter, leave = interval(origin, _into(geom.rotation, to_light), geom.size)
            return dark | ((enter <= leave) & (leave > 0.0) & geom.shown)

        # A plane is ground or table here: it lies under everything the light reaches.
        dark = _scan_geoms(primitives, poses, jnp.zeros_like(hit), occluded, skip=(PLANE,))
        lit = jnp.where(dark, 0.0, lit)
    brightness = AMBIENT + HEADLIGHT * facing + SUN * lit
    colour = jnp.where(hit[:, None], rgba[geom, :3] * brightness[:, None], jnp.asarray(SKY, jnp.float32))
    return colour, distance, winner


def pixel_directions(camera: Camera, height: int, width: int) -> Array:
    """World directions float32 (H, W, 3) of the pixels' rays, scaled to Z = 1 in the camera frame.

    Pixel (u, v) looks along K^-1 [u, v, 1] with integer indices, as PyRep unprojects (no half-pixel shift).
    """
    k = camera.intrinsics
    v, u = jnp.meshgrid(jnp.arange(height, dtype=jnp.float32), jnp.arange(width, dtype=jnp.float32), indexing="ij")
    y = (v - k[1, 2]) / k[1, 1]
    x = (u - k[0, 2] - k[0, 1] * y) / k[0, 0]
    local = jnp.stack([x, y, jnp.ones_like(x)], -1)
    return jnp.einsum("ij,...j->...i", camera.world_from_camera[:3, :3], local, precision=jax.lax.Precision.HIGHEST)


@functools.partial(jax.jit, static_argnames=("height", "width", "shadows", "far", "max_block_rays"))
def render(
    primitives: Primitives,
    geom_xpos: Array,
    geom_xmat: Array,
    geom_rgba: Array,
    camera: Camera,
    height: int,
    width: int,
    shadows: bool = True,
    far: float = FAR,
    max_block_rays: int = MAX_BLOCK_RAYS,
) -> tuple[Array, Array, Array]:
    """One picture of the scene.

    geom_xpos float32 (Ng, 3) and geom_xmat float32 (Ng, 3, 3) (or (Ng, 9)): world poses of all geoms of the model.
    max_block_rays: rows are cast in blocks of up to so many rays, one after the other, which bounds the memory.
    geom_rgba float32 (Ng, 4) in [0, 1]; a geom with alpha 0 is not drawn, any other alpha is opaque.
    Returns rgb uint8 (H, W, 3); depth float32 (H, W), planar metres, 0 where nothing is hit up to ``far``; and
    segmentation int32 (H, W), the geom id or -1 where nothing is hit. Surfaces beyond ``far`` keep colour and id.
    """
    poses = Poses(
        xpos=jnp.asarray(geom_xpos, jnp.float32),
        xmat=jnp.asarray(geom_xmat, jnp.float32).reshape(-1, 3, 3),
        rgba=jnp.asarray(geom_rgba, jnp.float32),
    )
    rows = max(n for n in range(1, height + 1) if height % n == 0 and (n == 1 or n * width <= max_block_rays))
    eye = jnp.asarray(camera.world_from_camera, jnp.float32)[:3, 3]
    directions = pixel_directions(camera, height, width).reshape(height // rows, rows * width, 3)

    def block(rays: Array) -> tuple[Array, Array, Array]:
        return _cast(primitives, poses, eye, Vector(*rays.T), shadows)

    if rows == height:
        colour, t, winner = block(directions[0])
    else:
        colour, t, winner = jax.lax.map(block, directions)
    rgb = jnp.clip(jnp.round(colour.reshape(height, width, 3) * 255.0), 0, 255).astype(jnp.uint8)
    depth = t.reshape(height, width)
    return rgb, jnp.where(depth <= far, depth, 0.0), winner.reshape(height, width)
